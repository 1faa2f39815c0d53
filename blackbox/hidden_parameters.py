"""The numbers of the shipped plant. Do not read them if you want to identify it.

Only ``blackbox/build.py`` imports this file; a test holds everything else to that.
"""

from blackbox.plant import PlantParameters

PARAMETERS = PlantParameters(
    mass=1.0,
    gravity=9.80665,
    battery_drain=1.0,
    lag=(0.031, 0.037, 0.058, 0.044),
    max_rate=(618.0, 618.0, 120.0),
    # (1 + u) (-8.84 + 4.1 u - 0.9 u^2 + 0.95 V), and a little that the idling motors give.
    thrust=(-8.81, -4.74, 3.2, -0.9, 0.95, 0.95),
    body_drag=(0.0046, 0.0058, 0.0105),
    rotor_drag=0.0105,
    translational_lift=0.05,
    translational_speed=7.0,
    ground_radius=0.14,
)
