# SPDX-License-Identifier: MIT
"""An environment whose frames encode environment, episode and step, and a server that reads the code."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, ClassVar, TypeAlias

import gymnasium as gym
import numpy as np

from rfm_client import RewardClient, ServerUnavailableError, UInt8Array
from shelves import Shelf
from transports import Answer, Tensors

SIZE_PX = 32

Code: TypeAlias = tuple[int, int, int]  # environment, episode, step


def frame_of(*code: int) -> UInt8Array:
    """Return a unique frame that encodes environment, episode and step."""
    frame = np.random.default_rng(code).integers(0, 256, (SIZE_PX, SIZE_PX, 3), np.uint8)
    frame[0, 0] = code
    return frame


class CodedEnv(gym.Env[Any, Any]):
    """Odd environments truncate, even ones terminate.

    lengths: steps of the episodes, in turn
    reuse: all frames are drawn into the same array
    bad: a code for which rendering gives no picture
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 10}
    action_space: gym.spaces.Space[Any] = gym.spaces.Discrete(2)

    def __init__(self, number: int = 0, lengths: Sequence[int] = (3,), *, reuse: bool = False, bad: Code | None = None):
        self.render_mode = "rgb_array"
        self.observation_space = gym.spaces.Dict({"pixels": gym.spaces.Box(0, 255, (SIZE_PX, SIZE_PX, 3), np.uint8)})
        self.number, self.lengths, self.reuse, self.bad = number, lengths, reuse, bad
        self.episode, self.t = -1, 0
        self.canvas = np.zeros((SIZE_PX, SIZE_PX, 3), np.uint8)

    @property
    def code(self) -> Code:
        """The current frame."""
        return self.number, self.episode, self.t

    @property
    def has_ended(self) -> bool:
        """True if the next step would follow the episode's end."""
        return self.t >= self.lengths[self.episode % len(self.lengths)]

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.episode, self.t = self.episode + 1, 0
        return {"pixels": self._drawn()}, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert not self.has_ended
        self.t += 1
        ends = self.has_ended
        return {"pixels": self._drawn()}, 1.0, ends and self.number % 2 == 0, ends and self.number % 2 == 1, {}

    def render(self) -> Any:
        return self._drawn()[0] if self.code == self.bad else self._drawn()

    def _drawn(self) -> UInt8Array:
        if not self.reuse:
            return frame_of(*self.code)
        self.canvas[:] = frame_of(*self.code)
        return self.canvas


class ReturningEnv(CodedEnv):
    """Every episode begins and ends in one pose. since: the first episode that ends there"""

    def __init__(self, since: int = 0) -> None:
        super().__init__(lengths=(2,))
        self.since = since

    @property
    def code(self) -> Code:
        return self.number, 0, 0 if self.episode >= self.since and self.has_ended else self.t


class CodeReader(Shelf):
    """A stand-in server. Keeps the frames' codes and the task of every question, by request.

    failing: number of the request that fails
    """

    def __init__(self, failing: int | None = None) -> None:
        super().__init__(has_encoder=False)
        self.calls: list[list[tuple[list[Code], str]]] = []
        self.pixels: list[list[UInt8Array]] = []  # of each window
        self.failing = failing

    async def infer(
        self, model: str, inputs: Tensors, outputs: Collection[str], timeout_s: float, *, request_id: str = ""
    ) -> Answer:
        counts = inputs["num_frames"][:, 0]
        windows = [list(frames[:count]) for frames, count in zip(inputs["frames"], counts, strict=True)]
        self.pixels += windows
        codes: list[list[Code]] = [[tuple(frame[0, 0].tolist()) for frame in window] for window in windows]
        tasks = [task.decode() for task in inputs["task"][:, 0]]
        self.calls.append(sorted(zip(codes, tasks, strict=True)))
        if len(self.calls) - 1 == self.failing:
            raise ServerUnavailableError("the server is restarting")
        answer = await super().infer(model, inputs, outputs, timeout_s)
        tensors = {name: array.copy() for name, array in answer.tensors.items()}  # which are one array
        for row, of_window in enumerate(codes):
            for name, scores in self.scores(of_window).items():
                tensors[name][row, : len(of_window)] = scores
        return Answer(tensors, answer.model_version)

    def scores(self, codes: list[Code]) -> dict[str, Any]:
        """Outputs of a window in place of the shelf's."""
        return {}


class Recorder(RewardClient):
    """A client of such a server."""

    def __init__(self, failing: int | None = None, server: CodeReader | None = None) -> None:
        self.server = server or CodeReader(failing)
        super().__init__("", transports=[self.server], retry=False)

    @property
    def calls(self) -> list[list[tuple[list[Code], str]]]:
        return self.server.calls

    @property
    def pixels(self) -> list[list[UInt8Array]]:
        return self.server.pixels
