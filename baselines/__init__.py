"""Training code that uses FlyTrack through its public names only."""
