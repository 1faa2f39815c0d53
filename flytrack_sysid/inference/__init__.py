"""What the fit and the diagnosis share: from the rows of a log to parameters and their intervals.

A module imports only modules before it:

- ``record``: a log's rows on one clock, without gaps.
- ``parameters``: a model's parameters as one vector, with names and bounds.
- ``trace_cache``: programs that are traced once.
- ``replay``: a model's step from every row.
- ``one_step``: a model's step from every row; ``free_flight``: many steps from measured states.
- ``lateness``, ``chunks``: clocks of the channels, and the chunks a log is cut into.
- ``noise``: what the residuals of a log are made of, and whitening.
- ``problem``: residuals of many models on many chunks, and their slopes.
- ``score_test``: whether parameters at their neutral values should leave them.
- ``search``: Gauss-Newton.
"""
