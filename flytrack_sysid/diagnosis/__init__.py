"""What a simulation gets wrong, from a flight log: named causes, what cannot be told apart, what is left."""
