"""Files from strangers: every kind of file that is read, damaged at random and on purpose (``files.py``)."""
