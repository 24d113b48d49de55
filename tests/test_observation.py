"""Observations made of blocks: what is shown, and what is read back."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from models import begin, make_model, next_row

from filtergym.envs.contract.observation import (
    BOUNDED_LOG,
    LOG1P,
    SIGNED_LOG,
    STORED_AS_LOG1P,
    Block,
    Blocks,
    Quantity,
    linear_scale,
)

BLOCKS = (
    Block("a", lambda state, _: state.a, "two numbers", ("x", "y"), SIGNED_LOG),
    Block("b", lambda state, measurement: state.b + measurement, "one number"),
    Block("c", lambda state, _: state.c, "kept as a logarithm", compression=STORED_AS_LOG1P),
    Block("d", lambda state, _: state.d, "four numbers in two axes", ("1x", "1y", "2x", "2y"), SIGNED_LOG),
    Block("e", lambda state, _: state.e, "scaled", compression=linear_scale(0.1, 45.0), unit="10 dB"),
    Block("f", lambda state, _: state.f, "a square", compression=LOG1P),
)
QUANTITIES = (
    Quantity("sum", "m", "a and b", lambda read: read("a") + read("b")),
    Quantity("twice", "m", "of the sum", lambda read: 2.0 * read("sum")),
)


@pytest.fixture
def state():
    rng = np.random.default_rng(0)
    return SimpleNamespace(
        a=1e3 * rng.normal(size=(2, 8)),
        b=rng.normal(size=8),
        c=np.log1p(np.arange(8.0)),
        d=rng.normal(size=(2, 2, 8)),
        e=np.arange(40.0, 48.0),
        f=np.arange(8.0) ** 2,
    )


def test_blocks_give_fields_and_observation(state):
    blocks = Blocks(BLOCKS, QUANTITIES, np)
    names = [field.name for field in blocks.fields]
    assert names == ["a_x", "a_y", "b", "c", "d_1x", "d_1y", "d_2x", "d_2y", "e", "f"]
    assert blocks.fields[0].description == "sign(x) log(1 + |x|) of two numbers"
    assert blocks.fields[8].unit == "10 dB"
    signed = np.sign(state.a) * np.log1p(abs(state.a))
    deep = state.d.reshape(4, 8)
    expected = np.concatenate(
        [
            signed,
            (state.b + 0.5)[None],
            state.c[None],
            np.sign(deep) * np.log1p(abs(deep)),
            0.1 * (state.e - 45.0)[None],
            np.log1p(state.f)[None],
        ]
    )
    np.testing.assert_array_equal(blocks.observe(state, 0.5), expected)
    assert blocks.columns(["d_1y", "a_x"]) == [5, 0]


def test_readers_undo_what_the_observation_does(state):
    blocks = Blocks(BLOCKS, QUANTITIES, np)
    observation = blocks.observe(state, 0.5).T
    for name, value in (("a", state.a.T), ("c", np.arange(8.0)[:, None]), ("e", state.e[:, None])):
        # Logarithm and exponential round once each.
        np.testing.assert_allclose(blocks.reader(name)(observation), value, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(blocks.reader("d")(observation), state.d.reshape(4, 8).T, rtol=1e-13)
    total = state.a.T + (state.b + 0.5)[:, None]
    np.testing.assert_allclose(blocks.reader("twice")(observation), 2.0 * total, rtol=1e-13)


@pytest.mark.parametrize("shown", [SIGNED_LOG, BOUNDED_LOG, LOG1P])
def test_no_number_is_shown_beyond_the_limits(shown):
    largest = np.finfo(np.float64).max
    low, high = shown.limits
    values = shown.forward(np.array([-largest if low < 0.0 else 0.0, largest]), np)
    assert low <= values[0] < 0.97 * low or low == values[0] == 0.0
    assert 0.97 * high < values[1] <= high


def test_limits_follow_a_scale():
    blocks = Blocks([Block("e", lambda s, _: s, "e", "xy", linear_scale(0.1, 45.0, (0.0, 90.0)))], (), np)
    np.testing.assert_allclose(blocks.limits, [[-4.5, -4.5], [4.5, 4.5]], rtol=1e-15)


def test_a_bounded_logarithm_is_the_value_near_zero_and_below_eight_everywhere():
    blocks = Blocks((Block("g", lambda state, _: state, "anything", compression=BOUNDED_LOG),), (), np)
    values = np.array([0.0, 1e-7, -1e-7, 1.0, -math.e + 1.0, 1e4, -1e4, 1e300])
    shown = blocks.observe(values, None)[0]
    by_hand = [math.copysign(math.log1p(abs(x)), x) for x in values]
    np.testing.assert_allclose(shown, [y / (1.0 + abs(y) / 8.0) for y in by_hand], rtol=1e-14)
    np.testing.assert_allclose(shown[:3], values[:3], rtol=1e-6)
    assert shown[4] == pytest.approx(-1.0 / 1.125, rel=1e-14)
    assert (abs(shown) < 8.0).all()
    # Read back with what is left of the digits so near the bound.
    read = blocks.reader("g")(shown[:, None])[:, 0]
    np.testing.assert_allclose(read[:7], values[:7], rtol=1e-12)
    assert read[7] == pytest.approx(1e300, rel=1e-9)
    assert blocks.fields[0].description == "y / (1 + |y| / 8) with y = sign(x) log(1 + |x|) of anything"


def test_unknown_and_repeated_names():
    blocks = Blocks(BLOCKS, QUANTITIES, np)
    with pytest.raises(ValueError, match="unknown quantity 'g' of the observation: choose from a, b"):
        blocks.reader("g")
    with pytest.raises(ValueError, match="names of an observation must differ"):
        Blocks((*BLOCKS, BLOCKS[0]), (), np)


def test_innovation_in_metres_is_the_measured_minus_the_predicted_position():
    model = make_model("filtergym/ManeuveringTarget-v0", "gain", "missed-detections")
    rng = np.random.default_rng(5)
    episode = begin(model, rng, 8)
    for _ in range(20):
        episode = model.measure(episode, next_row(model, rng, 8))
        read = model.reader("innovation_in_metres")(model.observe(episode).T)
        seen = episode.measurement.available > 0.0
        expected = np.where(seen, episode.measurement.position - episode.filter.predicted, 0.0).T
        # The share 1 - R/S that it is read from cancels digits when S is little larger than R.
        np.testing.assert_allclose(read, expected, rtol=1e-12, atol=1e-9)
        episode = model.act(episode, np.zeros((1, 8)))
