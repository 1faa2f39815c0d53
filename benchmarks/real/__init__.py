"""Figures on measured flights: leave-one-policy-out on a Crazyflie, beside black boxes of the same rows."""
