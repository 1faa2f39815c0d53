"""Track files are read and written; all else is refused with file, field and reason."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from flytrack_env.references import ReferenceFileError, shipped_reference
from flytrack_env.tracks import Gate, Track, TrackError, load_track, save_track
from tests.support.tables import table

VALID = (Path(__file__).parents[1] / "support" / "small_track.toml").read_text(encoding="utf-8")


def load_text(folder, text):
    """Return the track of a file's content."""
    path = folder / "track.toml"
    path.write_bytes(text.encode())
    return load_track(path)


def test_valid_file_is_read(tmp_path):
    for end in ("\n", "\r\n"):
        track = load_text(tmp_path, VALID.replace("\n", end))
        assert load_track(str(tmp_path / "track.toml")) == track
        assert (track.name, [gate.id for gate in track.gates]) == ("small", [7, 3])
        assert [gate.direction for gate in track.gates] == [1.0, -1.0]
        assert (track.gates[1].opening, track.gates[1].frame) == (1.0, 2.0)
        assert track.bounds_high == (15.0, 5.0, 5.0)


CASES = table("tracks")
REFUSALS = CASES["refused"]


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals_name_file_field_and_reason(case, tmp_path):
    old, new, field, reason = REFUSALS[case]
    assert VALID.count(old) == 1, "the replaced text must be unique"
    with pytest.raises(TrackError) as caught:
        load_text(tmp_path, VALID.replace(old, new))
    message = str(caught.value)
    assert message.startswith(f"{tmp_path / 'track.toml'}: {field}: ") and len(message) < 500
    assert reason in message


def test_unknown_names_are_refused_with_the_shipped_ones_and_lead_to_no_other_file():
    for name in ("monza", "", "../tracks/flytrack", "FLYTRACK"):
        with pytest.raises(TrackError, match=rf"track: found '{name}', expected one of .*flytrack"):
            load_track(name)
    for name in ("../references/flytrack", "x" * 300, "a\0b"):
        with pytest.raises(
            ReferenceFileError, match=r"reference: found no .{1,60}, expected one of"
        ):
            shipped_reference(name)


def any_track(seed):
    """Return a track at random that the loader must accept, of tiny numbers and large ones."""
    rng = np.random.default_rng(seed)
    low, high = -(10.0 ** rng.uniform(-20.0, 2.0, 3)), 10.0 ** rng.uniform(0.0, 2.0, 3)

    def inside():
        return tuple(rng.uniform(low, high).tolist())

    def turn():
        return tuple(Rotation.random(rng=rng).as_quat().tolist())

    gates = []
    for gate_id in rng.permutation(100)[: rng.integers(2, 7)].tolist():
        opening, sign = rng.uniform(0.1, 3.0), float(rng.choice([-1.0, 1.0]))
        gates.append(
            Gate(gate_id, inside(), turn(), sign, opening, opening + rng.uniform(0.1, 2.0))
        )
    return Track("any", tuple(gates), inside(), turn(), tuple(low.tolist()), tuple(high.tolist()))


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), name=st.text(st.characters(codec="utf-8"), min_size=1))
def test_saved_tracks_are_read_back_equal(seed, name, tmp_path_factory):
    path, track = tmp_path_factory.getbasetemp() / "saved.toml", replace(any_track(seed), name=name)
    save_track(path, track)
    assert load_track(path) == track


UNSAVEABLE = CASES["unsaveable"]


@pytest.mark.parametrize("reason", UNSAVEABLE)
def test_what_would_not_come_back_is_not_saved(reason, tmp_path):
    track, path = load_track("flytrack"), tmp_path / "saved.toml"
    gates = (replace(track.gates[0], **UNSAVEABLE[reason]), *track.gates[1:])
    with pytest.raises(TrackError, match=rf"{re.escape(str(path))}.*{re.escape(reason)}"):
        save_track(path, replace(track, gates=gates))
    with pytest.raises(
        TrackError, match=r"path: found '.*track.json', expected one that ends in .toml"
    ):
        save_track(tmp_path / "track.json", track)
    assert not list(tmp_path.iterdir())
