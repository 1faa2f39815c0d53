"""Figures on measured flights: leave-one-policy-out on a Crazyflie, and black boxes.

The black boxes learn from the same rows.
"""
