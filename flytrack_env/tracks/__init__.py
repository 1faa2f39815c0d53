"""Tracks: data files and their loader, the geometry of gates, feasibility, random courses."""

from flytrack_env.tracks.course import (
    Course,
    Crossing,
    GateFrame,
    build_course,
    cross_gate,
    hermite_curve,
    sample_way,
    way_length,
)
from flytrack_env.tracks.feasibility import DEMANDS, Limits, Problem, find_problems
from flytrack_env.tracks.random_track import random_track
from flytrack_env.tracks.track import (
    Gate,
    Track,
    TrackError,
    available_tracks,
    load_track,
    save_track,
)

__all__ = [
    "DEMANDS",
    "Course",
    "Crossing",
    "Gate",
    "GateFrame",
    "Limits",
    "Problem",
    "Track",
    "TrackError",
    "available_tracks",
    "build_course",
    "cross_gate",
    "find_problems",
    "hermite_curve",
    "load_track",
    "random_track",
    "sample_way",
    "save_track",
    "way_length",
]
