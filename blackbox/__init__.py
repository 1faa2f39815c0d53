"""The plant that FlyTrack ships as a black box; see README.md."""
