"""Finding, replaying and reporting time-optimal laps."""
