"""Checks of what is given to users: the wheel, the source distribution, the versions of what they need."""
