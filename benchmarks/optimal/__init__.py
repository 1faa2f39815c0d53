"""How time-optimal laps are found and verified, and how flights compare with them."""
