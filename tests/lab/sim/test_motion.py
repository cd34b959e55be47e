"""Motion within one period: exact integration, and stopping paths that are what braking really does."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gr_ros2_lab.sim.motion import ACCELERATION, MAX_TURN, TICK, TURN_ACCELERATION, State, stopping_paths

speeds = st.floats(0, 2)
turns = st.floats(-MAX_TURN, MAX_TURN)


@given(speeds, turns)
def test_constant_speed_and_turn_draw_an_arc(speed: float, turn: float) -> None:
    end = State(1.0, 2.0, 0.3, speed, turn).after(TICK)
    if abs(turn) > 1e-6:
        radius = speed / turn
        assert end.x == pytest.approx(1.0 + radius * (math.sin(0.3 + turn * TICK) - math.sin(0.3)), abs=1e-8)
        assert end.y == pytest.approx(2.0 - radius * (math.cos(0.3 + turn * TICK) - math.cos(0.3)), abs=1e-8)
    assert end.heading == pytest.approx(0.3 + turn * TICK)


@given(speeds, turns, speeds, turns)
def test_a_command_is_reached_at_the_next_tick(speed: float, turn: float, to_speed: float, to_turn: float) -> None:
    end = State(0.0, 0.0, 0.0, speed, turn).towards(to_speed, to_turn).after(TICK)
    assert (end.speed, end.turn) == pytest.approx((to_speed, to_turn), abs=1e-12)


@given(speeds, turns, st.floats(-math.pi, math.pi))
def test_stopping_paths_are_what_braking_does(speed: float, turn: float, heading: float) -> None:
    state = State(3.0, 4.0, heading, speed, turn)
    longest = math.ceil(2 / (ACCELERATION * TICK))
    command = min(2.0, speed + ACCELERATION * TICK), max(-MAX_TURN, turn - TURN_ACCELERATION * TICK)
    path = stopping_paths(state, np.array([command[0]]), np.array([command[1]]), longest)[0]
    assert path.shape == (longest + 2, 2)
    for number, point in enumerate(path):
        assert point == pytest.approx([state.x, state.y], abs=1e-9)
        state = state.towards(*(command if number == 0 else state.braking())).after(TICK)
    assert state.speed == pytest.approx(0.0, abs=1e-9)
