import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from understudy.errors import RecordingError
from understudy.people_file import FramePeople, PeopleFile, frame_from_json, frame_to_json
from understudy.types import INFERRED, MISSING, OBSERVED, Keypoints2D, Palm, Person


def random_person(seed: int) -> Person:
    rng = np.random.default_rng(seed)
    rows = np.column_stack([rng.uniform(0, 900, (18, 2)).round(3), rng.uniform(0, 1, 18).round(3)])
    rows[rng.random(18) < 0.2] = 0
    seen = Keypoints2D.from_rows(rows)
    if rng.random() < 0.2:
        return Person.failure(seen, "no depth").with_id(int(rng.integers(9)))
    source = rng.choice([OBSERVED, INFERRED, MISSING], 18)
    keypoints = rng.normal(0, 2, (18, 3)).round(4)
    keypoints[source == MISSING] = np.nan
    sigma = np.where(source == MISSING, np.nan, rng.uniform(0, 0.2, 18).round(4))
    palm = Palm(np.array([0.6, 0.0, -0.8]), 0.75) if rng.random() < 0.5 else None
    return Person(
        seen, keypoints, rng.uniform(0, 1, 18).round(4), sigma, tuple(source), 3, {"left": None, "right": palm}
    )


@given(st.lists(st.integers(0, 2**31), max_size=3), st.none() | st.floats(0, 1e6), st.none() | st.text(min_size=1))
@settings(max_examples=40, deadline=None)
def test_round_trip(seeds, timestamp, skipped):
    frame = FramePeople(7, tuple(random_person(s) for s in seeds), timestamp, skipped)
    data = json.loads(json.dumps(frame_to_json(frame), allow_nan=False))
    back = frame_from_json(data, "x")
    assert (back.index, back.timestamp_s, back.skipped) == (7, timestamp, skipped)
    for a, b in zip(frame.people, back.people, strict=True):
        assert (a.id, a.failed, a.source) == (b.id, b.failed, b.source)
        np.testing.assert_array_equal(a.keypoints, b.keypoints)
        np.testing.assert_array_equal(a.sigma_m, b.sigma_m)
        np.testing.assert_array_equal(a.keypoints_2d.rows(), b.keypoints_2d.rows())
        assert (a.hands["right"] is None) == (b.hands["right"] is None)
    assert frame_to_json(back) == frame_to_json(frame)


def test_what_the_format_says(tmp_path):
    """The keys of people/1, and null where there is nothing."""
    person = Person(
        Keypoints2D.from_rows(np.tile((5.0, 6.0, 0.5), (18, 1))),
        np.vstack([np.full((1, 3), np.nan), np.ones((17, 3))]),
        np.full(18, 0.5),
        np.append(np.nan, np.full(17, 0.02)),
        (MISSING,) + (OBSERVED,) * 17,
        4,
    )
    failure = Person.failure(person.keypoints_2d, "no depth").with_id(5)
    path = tmp_path / "people.json"
    PeopleFile("naive", "REC", (FramePeople(0, (person, failure), 0.5),)).write(path)
    data = json.loads(path.read_text())
    assert [data[k] for k in ("format", "method", "recording")] == ["people/1", "naive", "REC"]
    frame = data["frames"][0]
    assert frame["index"] == 0 and frame["timestamp_s"] == 0.5
    first, second = frame["people"]
    assert set(first) == {"id", "keypoints", "confidence", "sigma_m", "source", "keypoints_2d", "hands"}
    assert first["keypoints"][0] is None and first["keypoints"][1] == [1, 1, 1] and first["sigma_m"][0] is None
    assert first["keypoints_2d"][0] == [5, 6, 0.5] and first["hands"] == {"left": None, "right": None}
    assert second["failed"] == "no depth" and "keypoints" not in second and second["id"] == 5
    assert PeopleFile.read(path).frames[0].people[1].failed == "no depth"


@pytest.mark.parametrize(
    "change, message",
    [
        ({"format": "people/2"}, "field 'format' must be 'people/1', got 'people/2'"),
        ({"frames": {}}, "field 'frames' must be a list"),
        ({"frames": [{"people": []}]}, r"frames\[0\]: must be an object with a whole number 'index'"),
        ({"frames": [{"index": 0}]}, r"frames\[0\]: field 'people' must be a list"),
        ({"frames": [{"index": 0, "people": [{}]}]}, r"people\[0\].keypoints_2d: must be a list of 18 rows"),
        ({"frames": [{"index": 0, "people": [], "timestamp_s": "x"}]}, "timestamp_s: must be a number, got 'x'"),
        ({"frames": [{"index": 0, "people": [], "skipped": 1}]}, "skipped: must be a text"),
        (
            {"frames": [{"index": 0, "people": [{"id": "x", "keypoints_2d": [[1, 2, 0.5]] * 18}]}]},
            r"\].id: must be a whole",
        ),
        (
            {"frames": [{"index": 0, "people": [{"hands": [1], "keypoints_2d": [[1, 2, 0.5]] * 18}]}]},
            "hands: must be an obj",
        ),
    ],
)
def test_damaged(tmp_path, change, message):
    path = tmp_path / "people.json"
    path.write_text(json.dumps({"format": "people/1", "frames": []} | change))
    with pytest.raises(RecordingError, match=message) as caught:
        PeopleFile.read(path)
    assert str(path) in str(caught.value)


def test_files_that_are_not_there_or_not_json(tmp_path):
    with pytest.raises(RecordingError, match="absent.json: no such file"):
        PeopleFile.read(tmp_path / "absent.json")
    (tmp_path / "bad.json").write_bytes(b"\xff{")
    with pytest.raises(RecordingError, match="bad.json: not readable as JSON"):
        PeopleFile.read(tmp_path / "bad.json")
