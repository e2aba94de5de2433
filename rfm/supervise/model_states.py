# SPDX-License-Identifier: MIT
"""What becomes of a served model: its states, what can happen to it, and what is done then. The table is all of it.

Nothing here waits, requests or starts anything. ``model_watch`` feeds the events and does the actions.
"""

from __future__ import annotations

from collections.abc import Iterator
from enum import Enum


class State(Enum):
    """What a model is doing."""

    WAITING = "an ensemble that is to be loaded when its parts are ready"
    NEW = "it was not probed yet"
    READY = "it answers"
    LATE = "it gives no answer in time"
    ABSENT = "it is not loaded"
    PAUSED = "it waits for its next load"
    LOADING = "it is loaded"
    UNLOADING = "it has failed again and again, and is unloaded"
    GIVEN_UP = "it has failed again and again, and waits long for its next load"
    RETRYING = "it has failed again and again, and is loaded once more"


class Event(Enum):
    """What can happen to a model. The text of a fault is its reason."""

    ANSWERED = "a probe was answered; of an ensemble, Triton says that it is ready"
    BUSY = "a probe waits behind a batch that gets on"
    LATE = "a probe waits"
    ABSENT = "a probe finds nothing that is loaded"
    DEAD = "its process is dead"
    HUNG = "it gives no answer"
    BROKEN = "it fails at what it could answer before"
    LOST = "it is to be loaded into a Triton that was started again"
    CRASH_LOOP = "it has failed too often in a row"
    PAUSE_OVER = "its next load is due"
    SEEN_READY = "it was seen ready although it is unloaded: somebody has loaded it"
    DONE = "the load or unload has ended well"
    FAILED = "the load or unload has failed"


class Action(Enum):
    """What is done on the way to a state."""

    PAUSE = "choose when it is loaded next; if that was too often in a row, report it, and CRASH_LOOP follows"
    LOAD = "unload what there is, and load what was served"
    UNLOAD = "unload it"
    PAUSE_LONG = "it is loaded next after minutes"
    RENEW = "forget what probes said: its processes are others"


FAULTS = (Event.DEAD, Event.HUNG, Event.BROKEN)
UP = (State.NEW, State.READY, State.LATE, State.ABSENT)
HEALING = (State.PAUSED, State.LOADING, State.UNLOADING, State.GIVEN_UP, State.RETRYING)
CRASH_LOOPING = (State.UNLOADING, State.GIVEN_UP, State.RETRYING)

Row = tuple[State, Action | None]


def _while_up() -> Iterator[tuple[tuple[State, Event], Row]]:
    """Rows of the table for a model that is loaded, as far as is known. A late model stays ready: it may be busy."""
    for state in UP:
        yield (state, Event.ANSWERED), (State.READY, None)
        yield (state, Event.BUSY), (State.READY, None)
        yield (state, Event.LATE), (State.READY if state is State.READY else State.LATE, None)
        yield (state, Event.ABSENT), (State.ABSENT, None)
        yield (state, Event.LOST), (State.PAUSED, Action.PAUSE)
        for fault in FAULTS:
            yield (state, fault), (State.PAUSED, Action.PAUSE)


# An event that has no row in a state changes nothing there.
TABLE: dict[tuple[State, Event], Row] = {
    **dict(_while_up()),
    (State.WAITING, Event.ANSWERED): (State.READY, None),
    (State.WAITING, Event.LOST): (State.PAUSED, Action.PAUSE),
    (State.PAUSED, Event.PAUSE_OVER): (State.LOADING, Action.LOAD),
    (State.PAUSED, Event.SEEN_READY): (State.LOADING, Action.LOAD),
    (State.PAUSED, Event.CRASH_LOOP): (State.UNLOADING, Action.UNLOAD),
    (State.LOADING, Event.DONE): (State.NEW, Action.RENEW),
    (State.LOADING, Event.FAILED): (State.PAUSED, Action.PAUSE),
    (State.UNLOADING, Event.DONE): (State.GIVEN_UP, Action.PAUSE_LONG),
    (State.UNLOADING, Event.FAILED): (State.GIVEN_UP, Action.PAUSE_LONG),
    (State.GIVEN_UP, Event.PAUSE_OVER): (State.RETRYING, Action.LOAD),
    (State.GIVEN_UP, Event.SEEN_READY): (State.RETRYING, Action.LOAD),
    (State.RETRYING, Event.DONE): (State.NEW, Action.RENEW),
    (State.RETRYING, Event.FAILED): (State.UNLOADING, Action.UNLOAD),
}


class Lifecycle:
    """The state of one model, which only ``feed`` changes."""

    def __init__(self, state: State = State.NEW) -> None:
        self.state = state

    def feed(self, event: Event) -> Action | None:
        """Changes the state by the event, and gives the action to do."""
        self.state, action = TABLE.get((self.state, event), (self.state, None))
        return action
