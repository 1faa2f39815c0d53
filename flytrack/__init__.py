"""The command ``flytrack``: ``flytrack --help`` lists what it does. No other package uses it."""
