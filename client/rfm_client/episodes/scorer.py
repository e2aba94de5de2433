# SPDX-License-Identifier: MIT
"""Score steps through progress requests that send only the frames that the server lacks.

A server may lack more frames than expected: it restarted, dropped frames, or is another server. It then refuses, and
gets every frame. Either way, the answer equals that for a ``ProgressSample`` with the same frames.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter, OrderedDict
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial
from itertools import groupby, islice, zip_longest
from typing import TypeAlias
from weakref import WeakKeyDictionary

from rfm_client.contract import wire
from rfm_client.contract.description import ModelInfo
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError, RewardError
from rfm_client.contract.results import ProgressResult, Result
from rfm_client.contract.samples import UInt8Array
from rfm_client.contract.wire import frames_name
from rfm_client.episodes.options import StepScore
from rfm_client.episodes.steps import Steps, Window
from rfm_client.frames.blank_frames import FRAMES_IN_A_ROW
from rfm_client.scoring.samples import Call, SampleScorer, for_each, results_of
from rfm_client.transport.threads import off_loop

MAX_NEW_BYTES = 3 * 2**20  # frame bytes per request: the server prepares a request while the next is sent
MAX_NEW_BYTES_IN_TURN = 4 * 2**20  # the same for one episode, where a request waits for the answer to the last
MAX_REMEMBERED = 2**17  # digests of sent frames; the oldest are forgotten


Asked: TypeAlias = tuple[Steps, int]  # an episode, and the step to score


class _Server:
    """Frame digests that one server has received.

    number: the server's index
    num_refusals: how often the server lacked frames that it had received
    """

    def __init__(self, number: int) -> None:
        self.number, self.num_refusals = number, 0
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
        """Return a score for each step, from as few requests as possible. Raises RewardError, ValueError."""
        info = await self.model_info(call)
        shown = [steps.windows(step, info) for steps, step in asked]
        outcomes = iter(await self._all_outcomes([each for _, windows in shown for each in windows], info, call))
        ms = call.deadline.passed_s * 1e3
        return [
            steps.score(step, prefix, list(islice(outcomes, len(windows))), ms)
            for (steps, step), (prefix, windows) in zip(asked, shown, strict=True)
        ]

    async def in_turn(
        self, windows: Sequence[Window], info: ModelInfo, begin: Callable[[], Call], go_on: Callable[[], None]
    ) -> list[Result]:
        """Return results for one episode's windows. A request waits for the one before, so each frame travels once.

        If the server keeps too few frames, the later requests send all that they show, once each.

        begin: returns the call for a request
        go_on: called before each request; may raise to end the episode

        Raises RewardError.
        """
        self._scorer.tell_of_length(max(len(window.frames) for window in windows), info)
        call, results = begin(), list[Result]()
        outputs = (*wire.outputs_for((), info.scores, all_scores=call.all_scores), *call.outputs)
        server = self._server(windows[0])
        num_refusals = server.num_refusals
        count = min(max(MAX_NEW_BYTES_IN_TURN // windows[0].frames[0].pixels.nbytes, 1), info.max_batch_size)
        parts = [windows[start : start + count] for start in range(0, len(windows), count)]
        hashed = asyncio.create_task(_hashed(parts[0]))
        try:
            for part, following in zip_longest(parts, parts[1:], fillvalue=()):
                await hashed
                hashed = asyncio.create_task(_hashed(following))  # while the server scores
                go_on()
                results += results_of(list(await self._outcomes(part, outputs, begin())), "samples[{}]")
                if server.num_refusals > num_refusals:
                    shown = windows[: len(results)]
                    server.forget(frame.digest for window in shown for frame in window.frames)
        finally:
            hashed.cancel()
        return results

    async def _all_outcomes(self, windows: Sequence[Window], info: ModelInfo, call: Call) -> list[Result | RewardError]:
        self._scorer.tell_of_length(max((len(window.frames) for window in windows), default=0), info)
        enough = min(info.max_frames or FRAMES_IN_A_ROW, FRAMES_IN_A_ROW)  # a camera may begin with a black frame
        for frames in (dict.fromkeys(window.frames) for window in windows):
            if len(frames) >= enough:
                self._scorer.tell_of_blank([frame.pixels for frame in frames])
        if not info.by_digest:
            return await self._whole(windows, call)
        await _hashed(windows)
        outcomes: dict[int, Result | RewardError] = {}
        parts = list(self._parts(windows, info.max_batch_size))
        outputs = wire.outputs_for((), info.scores)
        asked = (self._outcomes([windows[index] for index in part], outputs, call) for part in parts)
        answered = await asyncio.gather(*asked)
        for part, of_part in zip(parts, answered, strict=True):
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
        self, windows: Sequence[Window], outputs: Sequence[str], call: Call
    ) -> Sequence[Result | RewardError]:
        """Send a request. If it fails, perhaps because the server lacks frames, send all frames, then whole samples."""
        server = self._server(windows[0])
        call = call.at(server.number)
        shown = {frame.digest: frame.pixels for window in windows for frame in window.frames}
        while True:
            sent = [pixels for digest, pixels in shown.items() if digest not in server]
            try:
                results = await self._request(windows, sent, outputs, call)
            except (InvalidSampleError, InferenceFailedError):
                server.forget(shown)
                if len(sent) < len(shown):
                    server.num_refusals += 1
                    continue
                return await self._whole(windows, call)
            except RewardError as error:
                return for_each(error, len(windows))
            server.remember(shown)
            return results

    def _server(self, window: Window) -> _Server:
        """Return the server for a window's episode; a new episode gets one with the fewest episodes."""
        if window.episode not in self._server_of:
            counts = Counter(self._server_of.values())
            fewest = min(counts[server] for server in self._servers)
            # at random: each of many clients may have a single episode
            self._server_of[window.episode] = random.choice([each for each in self._servers if counts[each] == fewest])
        return self._server_of[window.episode]

    async def _request(
        self, windows: Sequence[Window], sent: Sequence[UInt8Array], outputs: Sequence[str], call: Call
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


async def _hashed(windows: Sequence[Window]) -> None:
    """Compute the digests of the frames in these windows."""
    num_new = sum(w.num_bytes // len(w.frames) for w in windows)  # about one frame in each window is new
    await off_loop(num_new, lambda: [frame.digest for window in windows for frame in window.frames])


def _padded_bytes(num_windows: int, num_frames: int, frame_bytes: int) -> int:
    """Return how many bytes a request's frames take, spread evenly over its windows, with padding."""
    return num_windows * -(-num_frames // num_windows) * frame_bytes
