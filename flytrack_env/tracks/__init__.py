"""Tracks: one data file each, one loader, and the geometry of gates."""

from flytrack_env.tracks.course import Course, Crossing, GateFrame, build_course, cross_gate
from flytrack_env.tracks.track import Gate, Track, TrackError, available_tracks, load_track

__all__ = [
    "Course",
    "Crossing",
    "Gate",
    "GateFrame",
    "Track",
    "TrackError",
    "available_tracks",
    "build_course",
    "cross_gate",
    "load_track",
]
