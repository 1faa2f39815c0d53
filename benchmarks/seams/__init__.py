"""Seams between a simulator, a log and the code that reads it: flights, and faults put into them.

Shares no code with ``flytrack_sysid.check``, which ``benchmarks.check`` measures with it.
"""
