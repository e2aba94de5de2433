# SPDX-License-Identifier: MIT
"""One model of a running Triton: feeds its lifecycle with what happens, and does what that asks for."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

from rfm.launch.process import TritonServer
from rfm.launch.repository_api import RepositoryApiError
from rfm.supervise.back_off import BackOff, CrashLoopError
from rfm.supervise.background import Calls
from rfm.supervise.model_probe import ModelProbe
from rfm.supervise.model_processes import ProcessWatch
from rfm.supervise.model_reload import OwedAnswersError, Reload
from rfm.supervise.model_states import CRASH_LOOPING, FAULTS, HEALING, Action, Event, Lifecycle, State
from rfm.supervise.status import NO_REASON, Status
from rfm.supervise.triton_watch import Config

RETRY_S = 300.0  # after so many failures in a row that they are a crash loop


class ModelWatch:
    """Keeps one model answering. Whether Triton runs is another's business. All but its attempts is in one thread.

    probe: None for a model that cannot be probed, such as an ensemble: it is loaded when its parts are ready, which are
        probed, and Triton says whether it is ready
    processes: those of all the server's models
    say: takes a line about what fails again and again
    """

    def __init__(
        self,
        name: str,
        probe: ModelProbe | None,
        server: TritonServer,
        processes: ProcessWatch,
        status: Status,
        say: Callable[[str], None],
    ) -> None:
        self.name = name
        self._probe = probe
        self._server = server
        self._processes = processes
        self._status = status
        self._say = say
        self._lifecycle = Lifecycle(State.WAITING if probe is None else State.NEW)
        self._back_off = BackOff(f"model {name}")
        self._back_off.started()
        self._reload: Reload | None = None
        self._attempts: Calls[None] = Calls(f"rfm-heal-{name}", (RepositoryApiError, OSError, OwedAnswersError))
        self._due_s = 0.0  # the next attempt
        self._why = ""  # it is healed
        self._trouble = ""  # why its last load failed
        self.owing: str | None = None  # its processes, dead or stopped, owe answers, or did when a reload ended them

    @property
    def state(self) -> State:
        """Where it is in its lifecycle."""
        return self._lifecycle.state

    @property
    def is_healing(self) -> bool:
        """Whether it is loaded anew, or will be."""
        return self.state in HEALING

    @property
    def is_probed(self) -> bool:
        """Whether it is asked itself whether it answers; else Triton is asked whether it is ready."""
        return self._probe is not None

    @property
    def reason(self) -> str:
        """Why it is not ready; NO_REASON if it is."""
        after = f", after: {self._trouble}" if self._trouble else ""
        if self.state in CRASH_LOOPING:
            return f"it is loaded anew every {RETRY_S / 60:g} minutes{after}"
        if self.state in HEALING:
            return f"it is loaded anew{after}"
        return NO_REASON if self.state is State.READY else self.state.value

    def close(self) -> None:
        """Ends the care for the model, which stays as it is."""
        if self._reload is not None:
            self._reload.close()

    def restore(self, config: Config) -> None:
        """Loads the model into a Triton that was started again."""
        self._heal(Event.LOST, "tritonserver was started again", config)

    def record_ready(self, requested_s: float) -> None:
        """Records that Triton called the model ready at ``requested_s``. If it was unloaded, somebody may have loaded
        it.
        """
        if not self.is_probed:
            self._feed(Event.ANSWERED)
        out_since_s = None if self._reload is None else self._reload.out_since_s
        if out_since_s is not None and requested_s > out_since_s:
            self._feed(Event.SEEN_READY)

    def look(self, died: str | None, config: Config) -> str | None:
        """Takes in what has happened since the last look. Gives the reason if the model is healed from now on.

        died: how one of its processes has
        config: what it served when it was last ready
        """
        if self.is_healing:
            self._go_on()
            return None
        event = Event.DEAD if died else self._probed()
        if event in FAULTS:
            why = died or event.value
            self._status.record_probe(self.name, is_ok=False)
            if num_owed := self._processes.num_owed(self.name):  # then Triton is restarted, and the model with it
                self.owing = f"processes of {self.name} do not run, and owe {num_owed} answers"
                return None
            self._heal(event, why, config)
            return why
        if event is not None:
            self._feed(event)
        return None

    def _probed(self) -> Event | None:
        """What the model's probe says; None: nothing yet. A model that is late behind a batch in progress is busy."""
        if self._probe is None:
            return None
        event = self._probe.look()
        if event in (Event.LATE, Event.HUNG) and self._processes.is_getting_on(self.name):
            event = Event.BUSY
        self._status.record_probe(self.name, is_ok=event is Event.ANSWERED)
        return event

    def _heal(self, event: Event, why: str, config: Config) -> None:
        self._why, self._trouble = why, ""
        is_out, was_hung = event is Event.LOST, event is Event.HUNG
        self._reload = Reload(self.name, self._server, config, is_out=is_out, was_hung=was_hung)
        self._feed(event)
        self._go_on()

    def _go_on(self) -> None:
        """Feeds the end of an attempt, or that the next one is due."""
        assert self._reload is not None  # it makes the attempts
        if not self._attempts.is_under_way:
            if time.monotonic() >= self._due_s:
                self._feed(Event.PAUSE_OVER)
        elif (attempt := self._attempts.ended()) is None:
            self._reload.end_stalled(self._processes.of_model(self.name))
        else:
            error = attempt.exception()
            self._processes.forget(self._reload.ended)
            if isinstance(error, OwedAnswersError):
                self.owing = str(error)
            if error is not None:
                self._trouble = str(error)
            self._feed(Event.DONE if error is None else Event.FAILED)

    def _feed(self, event: Event) -> None:
        action = self._lifecycle.feed(event)
        if action is Action.PAUSE:
            self._pause()
        elif action is Action.PAUSE_LONG:
            self._due_s = time.monotonic() + RETRY_S
        elif action is Action.RENEW:
            self._renew()
        elif action is not None:
            self._begin(action)

    def _pause(self) -> None:
        try:
            self._due_s = time.monotonic() + self._back_off.pause_s(self._trouble or self._why)
        except CrashLoopError as error:
            self._trouble = self._trouble or self._why
            self._say(f"{error}; it is not ready, and tried again every {RETRY_S / 60:g} minutes")
            self._feed(Event.CRASH_LOOP)

    def _begin(self, action: Action) -> None:
        assert self._reload is not None  # made when the healing began
        attempt = self._reload.load if action is Action.LOAD else self._reload.unload
        self._attempts.begin(partial(attempt, self._processes.of_model(self.name)))

    def _renew(self) -> None:
        self._back_off.started()
        self._reload = None
        if self._probe is not None:
            self._probe.renew()
