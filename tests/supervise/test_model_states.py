# SPDX-License-Identifier: MIT
"""What becomes of a model, driven event by event: no process, no thread, no clock."""

from __future__ import annotations

import pytest

from rfm.supervise.model_states import FAULTS, HEALING, TABLE, UP, Action, Event, Lifecycle, State

# Each line: what happens, what is done about it, and where the model is then.
STORIES: dict[str, list[tuple[Event, Action | None, State]]] = {
    "it answers, is busy and late, and stays ready": [
        (Event.ANSWERED, None, State.READY),
        (Event.BUSY, None, State.READY),
        (Event.LATE, None, State.READY),
        (Event.ANSWERED, None, State.READY),
    ],
    "it is late before it ever answered": [
        (Event.LATE, None, State.LATE),
        (Event.LATE, None, State.LATE),
        (Event.BUSY, None, State.READY),
    ],
    "somebody unloads it and loads it": [
        (Event.ANSWERED, None, State.READY),
        (Event.ABSENT, None, State.ABSENT),
        (Event.LATE, None, State.LATE),
        (Event.ANSWERED, None, State.READY),
    ],
    "it dies and is loaded": [
        (Event.ANSWERED, None, State.READY),
        (Event.DEAD, Action.PAUSE, State.PAUSED),
        (Event.PAUSE_OVER, Action.LOAD, State.LOADING),
        (Event.DONE, Action.RENEW, State.NEW),
        (Event.ANSWERED, None, State.READY),
    ],
    "it cannot be loaded at once": [
        (Event.HUNG, Action.PAUSE, State.PAUSED),
        (Event.PAUSE_OVER, Action.LOAD, State.LOADING),
        (Event.FAILED, Action.PAUSE, State.PAUSED),
        (Event.PAUSE_OVER, Action.LOAD, State.LOADING),
        (Event.DONE, Action.RENEW, State.NEW),
    ],
    "somebody else loads it while it waits": [
        (Event.BROKEN, Action.PAUSE, State.PAUSED),
        (Event.SEEN_READY, Action.LOAD, State.LOADING),
        (Event.DONE, Action.RENEW, State.NEW),
    ],
    "it fails again and again, until somebody mends it": [
        (Event.DEAD, Action.PAUSE, State.PAUSED),
        (Event.CRASH_LOOP, Action.UNLOAD, State.UNLOADING),
        (Event.FAILED, Action.PAUSE_LONG, State.GIVEN_UP),
        (Event.PAUSE_OVER, Action.LOAD, State.RETRYING),
        (Event.FAILED, Action.UNLOAD, State.UNLOADING),
        (Event.DONE, Action.PAUSE_LONG, State.GIVEN_UP),
        (Event.SEEN_READY, Action.LOAD, State.RETRYING),
        (Event.DONE, Action.RENEW, State.NEW),
    ],
    "it is lost with its Triton": [
        (Event.LOST, Action.PAUSE, State.PAUSED),
        (Event.PAUSE_OVER, Action.LOAD, State.LOADING),
        (Event.DONE, Action.RENEW, State.NEW),
    ],
}


@pytest.mark.parametrize("story", STORIES.values(), ids=STORIES.keys())
def test_a_model_goes_the_way_of_its_story(story: list[tuple[Event, Action | None, State]]) -> None:
    model = Lifecycle()
    assert [(event, model.feed(event), model.state) for event, _, _ in story] == story


def test_an_ensemble_waits_for_its_parts() -> None:
    ensemble = Lifecycle(State.WAITING)
    assert (ensemble.feed(Event.DEAD), ensemble.state) == (None, State.WAITING)
    assert (ensemble.feed(Event.LOST), ensemble.state) == (Action.PAUSE, State.PAUSED)
    loaded = Lifecycle(State.WAITING)
    assert (loaded.feed(Event.ANSWERED), loaded.state) == (None, State.READY)


@pytest.mark.parametrize("state", UP)
@pytest.mark.parametrize("fault", FAULTS)
def test_every_fault_of_a_model_that_is_up_is_healed(state: State, fault: Event) -> None:
    assert TABLE[state, fault] == (State.PAUSED, Action.PAUSE)


@pytest.mark.parametrize("state", HEALING)
@pytest.mark.parametrize("event", [*FAULTS, Event.ANSWERED, Event.LATE, Event.ABSENT, Event.BUSY, Event.LOST])
def test_what_is_said_of_the_old_processes_changes_nothing_while_a_model_heals(state: State, event: Event) -> None:
    model = Lifecycle(state)
    assert (model.feed(event), model.state) == (None, state)


@pytest.mark.parametrize("start", State)
def test_there_is_a_way_back_to_ready_from_everywhere(start: State) -> None:
    reached = {start}
    for _ in State:
        reached |= {after for (before, _), (after, _) in TABLE.items() if before in reached}
    assert State.READY in reached


def test_every_state_is_reached_and_left_and_every_event_and_action_is_used() -> None:
    assert {before for before, _ in TABLE} == set(State)
    assert {after for after, _ in TABLE.values()} | {State.WAITING, State.NEW} == set(State)  # two are starts
    assert {event for _, event in TABLE} == set(Event)
    assert {action for _, action in TABLE.values()} - {None} == set(Action)
