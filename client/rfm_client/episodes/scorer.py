# SPDX-License-Identifier: MIT
"""Score steps through progress requests that send only the frames that the server lacks.

A server may lack more frames than expected: it restarted, dropped frames, or is another server. It then refuses, and
gets every frame. Either way, the answer equals that for a ``ProgressSample`` with the same frames.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter, OrderedDict
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby, islice
from typing import TypeAlias
from weakref import WeakKeyDictionary

from rfm_client.contract import wire
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError, RewardError
from rfm_client.contract.results import ProgressResult, Result
from rfm_client.contract.samples import Trajectory, UInt8Array
from rfm_client.contract.wire import frames_name
from rfm_client.episodes.options import StepScore
from rfm_client.episodes.steps import Frame, Steps, Window
from rfm_client.frames.blank_frames import FRAMES_IN_A_ROW
from rfm_client.frames.sampling import Sampling
from rfm_client.scoring.samples import Call, SampleScorer, for_each, results_of
from rfm_client.transport.threads import off_loop

MAX_NEW_BYTES = 3 * 2**20  # frame bytes per request: the server prepares a request while the next is sent
MAX_NEW_BYTES_IN_TURN = 4 * 2**20  # the same for one episode, where a request waits for the answer to the last,
LEAST_IN_TURN = 4  # unless it has fewer windows
MOST_REFUSALS = 3  # in an episode; then the server keeps too few frames
MAX_REMEMBERED = 2**17  # digests of sent frames; the oldest are forgotten


Asked: TypeAlias = tuple[Steps, int]  # an episode, and the step to score


class _Server:
    """Frame digests that one server has received. number: the server's index."""

    def __init__(self, number: int) -> None:
        self.number = number
        self._sent: OrderedDict[bytes, None] = OrderedDict()

    def __contains__(self, digest: bytes) -> bool:
        return digest in self._sent

    def remember(self, digests: Iterable[bytes]) -> None:
        for digest in digests:
            self._sent[digest] = None
            self._sent.move_to_end(digest)
        while len(self._sent) > MAX_REMEMBERED:
            self._sent.popitem(last=False)

    def forget(self, digests: Iterable[bytes]) -> None:
        for digest in digests:
            self._sent.pop(digest, None)


class StepScorer:
    """Scores steps for one client, in its event loop. A new episode goes to the server with the fewest episodes.

    model: the exported model's name
    """

    def __init__(self, model: str, scorer: SampleScorer, num_servers: int) -> None:
        self._model = frames_name(model)
        self._scorer = scorer
        self._servers = [_Server(number) for number in range(num_servers)]
        self._server_of: WeakKeyDictionary[object, _Server] = WeakKeyDictionary()  # for each running episode

    async def model_info(self, call: Call) -> ModelInfo:
        """Describe the model that scores windows. Raises RewardError."""
        return await self._scorer.model_info(self._model, call.deadline)

    async def scores(self, asked: Sequence[Asked], call: Call) -> list[StepScore]:
        """Return a score for each step, from as few requests as possible. Raises RewardError, ValueError.

        InferenceFailedError: another checkpoint scored an episode's earlier steps, or is not the one that it names
        """
        info = await self.model_info(call)
        shown = [steps.windows(step, info) for steps, step in asked]
        outcomes = iter(await self._all_outcomes([each for _, windows in shown for each in windows], info, call))
        ms = call.deadline.passed_s * 1e3
        scores = [
            steps.score(step, prefix, list(islice(outcomes, len(windows))), ms)
            for (steps, step), (prefix, windows) in zip(asked, shown, strict=True)
        ]
        for steps, _ in asked:
            steps.check_checkpoint(call.answered_by, self._scorer.changes)
        return scores

    async def in_turn(
        self,
        trajectory: Trajectory,
        sampling: Sampling,
        info: ModelInfo,
        begin: Callable[[], Call],
        go_on: Callable[[], None],
    ) -> list[Result]:
        """Return a result for each prefix. A request waits for the one before, so each frame travels once.

        If the server keeps too few frames, the later requests send all that they show, once each.

        begin: returns the call for a request
        go_on: called before each request; may raise to end the episode

        Raises RewardError.
        """
        frames = [Frame(pixels) for pixels in trajectory.positions]
        self._scorer.tell_of_length(len(sampling.prefix(len(frames) - 1).indices), info)
        call, results = begin(), list[Result]()
        outputs = (*wire.outputs_for((), info.scores), *call.outputs)
        count = max(MAX_NEW_BYTES_IN_TURN // frames[0].pixels.nbytes, LEAST_IN_TURN)
        count = min(count, info.max_batch_size or count)

        def prepared(start: int) -> list[Window]:
            """Return some windows, with the frames' digests."""
            of_prefixes = (sampling.prefix(t).indices for t in range(start, min(start + count, len(frames))))
            windows = [
                Window(tuple(frames[index] for index in indices), trajectory.task, trajectory)
                for indices in of_prefixes
            ]
            _hash(windows)
            return windows

        shown: set[bytes] = set()
        num_refusals = 0
        following = asyncio.create_task(asyncio.to_thread(prepared, 0))
        try:
            while windows := await following:
                following = asyncio.create_task(asyncio.to_thread(prepared, len(results) + len(windows)))
                go_on()  # the server scores while the next windows are prepared
                outcomes, was_refused = await self._outcomes(windows, dict.fromkeys(outputs), begin())
                results += results_of(list(outcomes), "samples[{}]")
                num_refusals += was_refused
                server, own = self._server(windows[0]), {frame.digest for each in windows for frame in each.frames}
                if was_refused:
                    server.forget(shown - own)
                if num_refusals > MOST_REFUSALS:
                    server.forget(own)
                shown |= own
        finally:
            following.cancel()
        return results

    async def _all_outcomes(self, windows: Sequence[Window], info: ModelInfo, call: Call) -> list[Result | RewardError]:
        self._scorer.tell_of_length(max((len(window.frames) for window in windows), default=0), info)
        enough = min(info.max_frames or FRAMES_IN_A_ROW, FRAMES_IN_A_ROW)  # a camera may begin with a black frame
        for frames in (dict.fromkeys(window.frames) for window in windows):
            if len(frames) >= enough:
                self._scorer.tell_of_blank([frame.pixels for frame in frames])
        if not info.by_digest:
            return await self._whole(windows, call)
        num_new = sum(w.num_bytes // len(w.frames) for w in windows)  # about one frame in each window is new
        await off_loop(num_new, _hash, windows)
        outcomes: dict[int, Result | RewardError] = {}
        parts = list(self._parts(windows, info.max_batch_size))
        outputs = wire.outputs_for((), info.scores)
        asked = (self._outcomes([windows[index] for index in part], outputs, call) for part in parts)
        answered = await asyncio.gather(*asked)
        for part, (of_part, _) in zip(parts, answered, strict=True):
            outcomes.update(zip(part, of_part, strict=True))
        return [outcomes[index] for index in range(len(windows))]

    def _parts(self, windows: Sequence[Window], limit: int) -> Iterator[list[int]]:
        """Yield window indices for each request.

        A request has frames of one size, for one server, at most ``limit`` windows, and at most MAX_NEW_BYTES unless a
        single window has more.
        """
        servers = [self._server(window) for window in windows]

        def alike(index: int) -> tuple[int, tuple[int, ...]]:
            return servers[index].number, windows[index].frames[0].pixels.shape

        for _, together in groupby(sorted(range(len(windows)), key=alike), key=alike):
            part: list[int] = []
            sent: set[bytes] = set()
            for index in together:
                frames = windows[index].frames
                own = {frame.digest for frame in frames if frame.digest not in servers[index]}
                num_bytes = _padded_bytes(len(part) + 1, len(sent | own), frames[0].pixels.nbytes)
                if part and (len(part) == limit or num_bytes > MAX_NEW_BYTES):
                    yield part
                    part, sent = [], set()
                part.append(index)
                sent |= own
            yield part

    async def _outcomes(
        self, windows: Sequence[Window], outputs: Collection[str], call: Call
    ) -> tuple[Sequence[Result | RewardError], bool]:
        """Return each window's outcome, and True if the server lacked frames that it had received.

        If a request fails, that server gets all frames, and after another error whole samples.
        """
        server = self._server(windows[0])
        call = call.at(server.number)
        shown = {frame.digest: frame.pixels for window in windows for frame in window.frames}
        sent = [pixels for digest, pixels in shown.items() if digest not in server]
        was_refused = False
        while True:
            try:
                results = await self._request(windows, sent, outputs, call)
            except (InvalidSampleError, InferenceFailedError) as error:
                server.forget(shown)
                if len(sent) == len(shown) or wire.UNKNOWN_FRAMES not in str(error):
                    return await self._whole(windows, call), was_refused
                sent, was_refused = list(shown.values()), True
            except RewardError as error:
                return for_each(error, len(windows)), was_refused
            else:
                server.remember(shown)
                return results, was_refused

    def _server(self, window: Window) -> _Server:
        """Return the server for a window's episode; a new episode gets one with the fewest episodes."""
        if window.episode not in self._server_of:
            counts = Counter(self._server_of.values())
            fewest = min(counts[server] for server in self._servers)
            # at random: each of many clients may have a single episode
            self._server_of[window.episode] = random.choice([each for each in self._servers if counts[each] == fewest])
        return self._server_of[window.episode]

    async def _request(
        self, windows: Sequence[Window], sent: Sequence[UInt8Array], outputs: Collection[str], call: Call
    ) -> Sequence[ProgressResult]:
        request_id = next(call.request_ids)
        num_bytes = _padded_bytes(len(windows), len(sent), sent[0].nbytes if sent else 0)
        videos = [[frame.digest for frame in window.frames] for window in windows]
        tasks = [window.task for window in windows]
        tensors = partial(wire.encode_refs, videos, tasks, sent)
        answer = await self._scorer.infer(self._model, num_bytes, tensors, outputs, call, request_id)
        return [
            wire.decode_progress(answer.tensors, row, len(window.frames), answer.model_version)
            for row, window in enumerate(windows)
        ]

    async def _whole(self, windows: Sequence[Window], call: Call) -> list[Result | RewardError]:
        samples = await off_loop(sum(w.num_bytes for w in windows), lambda: [window.sample for window in windows])
        return await self._scorer.outcomes(samples, call)


def _hash(windows: Sequence[Window]) -> None:
    """Compute the digests of the frames in these windows."""
    for window in windows:
        for frame in window.frames:
            frame.digest  # noqa: B018  computed at the first use


def _padded_bytes(num_windows: int, num_frames: int, frame_bytes: int) -> int:
    """Return how many bytes a request's frames take, spread evenly over its windows, with padding."""
    return num_windows * -(-num_frames // num_windows) * frame_bytes
