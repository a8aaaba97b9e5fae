"""Several clips of one set-up in the withheld exam: one set of objects, camera and effects, other starts."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pybullet")

from benchmarks.clips.bullet import bodies
from benchmarks.withheld.answer import call
from benchmarks.withheld.exam import Order, find_set_up
from benchmarks.withheld.plan import orders
from benchmarks.withheld.several import LASTING, PASSING


def test_clips_of_a_set_up_share_all_but_their_starts():
    take, more, _ = find_set_up(Order("one", ("slope",), "exact", (3, 0), 3))
    assert len(more) == 2
    for other in more:
        assert other.effects == take.effects
        assert other.solved[0].px >= 0.3 * take.solved[0].px
        assert other.stage.camera == take.stage.camera
        for a, b in zip(bodies(take.stage.entries), bodies(other.stage.entries), strict=True):
            assert {k: v for k, v in a.items() if k != "state"} == {k: v for k, v in b.items() if k != "state"}
            assert not np.allclose(a["state"]["position"], b["state"]["position"])


def test_one_clip_is_drawn_as_ever():
    take, more, _ = find_set_up(Order("none", (), "exact", (3, 1)))
    assert more == []
    again, _, _ = find_set_up(Order("none", (), "exact", (3, 1), 2))
    assert again.stage.entries == take.stage.entries


def test_effects_that_happen_once_belong_to_no_set_up():
    assert not set(LASTING) & set(PASSING)
    drawn = orders(0, {"one": 40}, clips=3)
    assert {order.clips for order in drawn} == {3}
    assert not {e for order in drawn for e in order.effects} & set(PASSING)
    assert {e for order in orders(0, {"one": 40}) for e in order.effects} & set(PASSING)


def test_the_call_names_every_clip(tmp_path):
    for name in ("init.yaml", "flows.npz", "init_2.yaml", "flows_2.npz"):
        (tmp_path / name).touch()
    (tmp_path / "without.txt").write_text("drag\n")
    told = call(tmp_path, tmp_path / "out", ("refine",))
    assert told[:10] == [
        "refine",
        "diagnose",
        *("--init", str(tmp_path / "init.yaml"), "--video", str(tmp_path / "flows.npz")),
        *("--init", str(tmp_path / "init_2.yaml"), "--video", str(tmp_path / "flows_2.npz")),
    ]
    assert told[-2:] == ["--without", "drag"]
    assert call(tmp_path, tmp_path / "out", ("refine",), alone=True).count("--video") == 1
