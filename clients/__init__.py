"""FlyTrack with RL code of others: what docs/clients.md shows, run by ``make test-clients``."""
