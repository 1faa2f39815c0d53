"""Recordings read back with Rerun's own reader, and flights to record."""

from collections import defaultdict

import numpy as np
import pytest

from tests.support.black_boxes import random_inputs


def make_flight(steps):
    """Return a random flight: states (T, 21) and actions (T, 4), float32."""
    states, actions = random_inputs(steps, seed=7)
    states[:, 0:3] = np.cumsum(0.1 * states[:, 0:3], axis=0)
    return states, actions


def make_sequence(steps):
    """Return the same as pairs of state and action."""
    return list(zip(*make_flight(steps), strict=True))


class Recording:
    """A recording's rows by (entity, component); times only for what is not static."""

    def __init__(self, path):
        missing = "this rerun-sdk has no reader (rerun.chunk)"
        reader = pytest.importorskip("rerun.chunk", reason=missing).RrdReader(path)
        (entry,) = reader.recordings()
        self.app_id = entry.application_id
        self.rows, self.times = defaultdict(list), defaultdict(list)
        self.timelines = set()
        for chunk in reader.stream().to_chunks():
            self._read(chunk)

    def _read(self, chunk):
        batch = chunk.to_record_batch()
        self.timelines |= set(chunk.timeline_names)
        if not chunk.is_static:
            steps = batch.column("step").to_pylist()
            nanoseconds = batch.column("sim_time").cast("int64").to_pylist()
            self.times[chunk.entity_path] += zip(steps, nanoseconds, strict=True)
        for name in set(batch.schema.names) - {"rerun.controls.RowId", *chunk.timeline_names}:
            self.rows[chunk.entity_path, name] += batch.column(name).to_pylist()

    def once(self, entity, component):
        """Return a static component's instances, logged exactly once."""
        assert not self.times[entity]
        (value,) = self.rows[entity, component]
        return np.array(value)

    def series(self, entity, component):
        """Return the one instance per row of a component, by steps; empty rows are left out."""
        rows = zip(self.times[entity], self.rows[entity, component], strict=True)
        rows = [row for _, row in sorted(rows, key=lambda pair: pair[0]) if row]
        assert {len(row) for row in rows} == {1}
        return np.array(rows)[:, 0]
