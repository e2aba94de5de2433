# SPDX-License-Identifier: MIT
"""The description of a served checkpoint, which the export writes as JSON to config.pbtxt for client and server."""

from __future__ import annotations

import json
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, cast

from rfm_client.contract import wire
from rfm_client.contract.checks import require
from rfm_client.contract.errors import InferenceFailedError, InvalidSampleError, InvalidValueError

DESCRIPTION_PARAMETER = "description"  # parameter in config.pbtxt
TOY = "toy checkpoint: scores of real videos mean nothing"
PUBLIC_CHECKPOINT = "robometer/Robometer-4B"
# weights_digest of the toy checkpoints in this repository: the demo's; the early one's, exported and as it was trained
_TOYS = ("7771918ab039e37c", "b26fc8fb5d62a7a2", "a21b3f750890fd03")
_WHERE = f"parameter {DESCRIPTION_PARAMETER}"

Rule: TypeAlias = Literal["shortest", "exact"]

_FORMS = "'shortest PX' or 'exact HEIGHTxWIDTH'"
_TEXT = re.compile(r"(?:(shortest) ([1-9][0-9]*))|(?:(exact) ([1-9][0-9]*)x([1-9][0-9]*))")


@dataclass(frozen=True)
class FrameSize:
    """The size to which a served checkpoint resizes every frame.

    rule: ``shortest`` (ReWiND's encoders): the shorter edge becomes px pixels, the other follows in proportion, rounded
        down; ``exact``: the frame gets this height and width
    edges_px: (px,), or (height, width) for ``exact``
    """

    rule: Rule
    edges_px: tuple[int, ...]

    @classmethod
    def parse(cls, text: str) -> FrameSize:
        """Parse ``shortest 256`` or ``exact 224x320``, as written by ``str``. Raises ValueError."""
        match = _TEXT.fullmatch(text)
        if match is None:
            raise InvalidValueError.at("frame_size", _FORMS, repr(text))
        rule, *edges = (part for part in match.groups() if part)
        return cls(cast(Rule, rule), tuple(map(int, edges)))

    def __str__(self) -> str:
        return f"{self.rule} {'x'.join(map(str, self.edges_px))}"

    def fitted(self, height: int, width: int) -> tuple[int, int]:
        """Return the (height, width) to shrink a frame to; never larger, because the server enlarges frames."""
        if self.rule == "exact":
            return min(height, self.edges_px[0]), min(width, self.edges_px[1])
        (px,) = self.edges_px
        edge = min(height, width)
        if edge <= px:
            return height, width
        other = int(px * max(height, width) / edge)  # rounds as the server does, which would otherwise resize again
        return (px, other) if height <= width else (other, px)


@dataclass(frozen=True, kw_only=True)
class Origin:
    """Facts known only at export; the exported files do not show them.

    source: the exported checkpoint's Hub id, or the end of its path; None: unknown
    revision: the Hub commit that was exported; None: the checkpoint was a folder
    license: the weights' licence, from the checkpoint's model card or config.json; None: unknown
    run_config: the training run's config.yaml, without secrets; empty: the checkpoint has none
    computation: number type, PyTorch version and attention kernel at export; None: unknown
    weights_difference: largest change that rounding the weights makes to the first of ``scores``, measured on noise at
        export; None: not measured
    """

    source: str | None = None
    revision: str | None = None
    license: str | None = None
    run_config: Mapping[str, Any] = field(default_factory=dict)
    computation: str | None = None
    weights_difference: float | None = None


@dataclass(frozen=True, kw_only=True)
class Description(Origin):
    """A checkpoint or one part: inputs, outputs, limits, origin. The model family writes it, the export completes it.

    New facts are fields with defaults, so older exports stay readable. Unknown JSON fields are ignored.

    kind: the reward model's name, such as TOPReward; None: unknown
    network: ``class`` and, for an exported checkpoint, its ``module``, ``config``, and for every part its class
        (``types``) and weight count (``parameters``)
    video_dim, text_dim: embedding widths D and Dt that the model reads, or writes as an encoder; None: neither
    progress_bins: how many progress bins C a discrete checkpoint has; None: continuous
    trained_frames: most frames per trajectory in training; None: unknown
    trained_padding: True if training padded shorter trajectories with their last frame, as upstream does, or if unknown
    network_frames: longest trajectory that the network can score, in frames; None: no limit
    frame_size: size to which the checkpoint resizes frames; None: it depends on the frame
    frames_per_value: consecutive frames that share a score; 2 if a vision-language model reads trajectories as videos
    has_progress, has_preference, has_success, has_similarity: True if the checkpoint gives these scores
    more_scores: frame scores beyond progress, success and progress bins: names of ``FrameScores`` fields
    scores_whole_prefixes: True if the FastAPI evaluation server shows the model all frames in a prefix, else four
    may_not_answer: True if an answer may hold no score, also for blank frames. The model then gets no warm-up, because
        Triton does not load a model whose warm-up fails
    needs_whole_episode: True if scores are relative to the whole episode, so the model cannot score a running episode
    asks_in_words: True for an ordinary language model, or one with its own heads, where no reward head is missing
    reads_views: True if the model reads further camera views and a goal; all others refuse samples with them
    keeps_features: True if the model can cache frame features; it then accepts samples with frame references
    uses_graphs: True if the predictor can score small batches with CUDA graphs
    is_large: True if float32 on the CPU is slow; exports are verified in the serving dtype, on a GPU with enough memory
    weights_digest: 16 hex digits, digest of the exported weights; None: not exported
    settings_digest: 16 hex digits, digest of everything else that decides scores: files beside the weights
        (configuration, tokenizer, image processor), dtype, device kind; None: not exported
    """

    kind: str | None = None
    network: Mapping[str, Any] = field(default_factory=dict)
    video_dim: int | None = None
    text_dim: int | None = None
    progress_bins: int | None = None
    trained_frames: int | None = None
    trained_padding: bool = True
    network_frames: int | None = None
    frame_size: FrameSize | None = None
    frames_per_value: int = 1
    has_progress: bool = True
    has_preference: bool = False
    has_success: bool = False
    has_similarity: bool = False
    more_scores: tuple[str, ...] = ()
    scores_whole_prefixes: bool = False
    may_not_answer: bool = False
    needs_whole_episode: bool = False
    asks_in_words: bool = False
    reads_views: bool = False
    keeps_features: bool = False
    uses_graphs: bool = False
    is_large: bool = False
    weights_digest: str | None = None
    settings_digest: str | None = None

    @property
    def widths(self) -> tuple[int, int] | None:
        """``video_dim`` and ``text_dim``; None: the model reads raw frames and writes scores."""
        return None if self.video_dim is None or self.text_dim is None else (self.video_dim, self.text_dim)

    @property
    def max_frames(self) -> int | None:
        """Most frames per trajectory: the smaller limit from training and network; None: both unknown."""
        return min((each for each in (self.trained_frames, self.network_frames) if each is not None), default=None)

    @property
    def scores(self) -> tuple[str, ...]:
        """Frame scores that the model gives: names of ``FrameScores`` fields."""
        bins = () if self.progress_bins is None else ("progress_logits",)
        return (*["progress"] * self.has_progress, *["success"] * self.has_success, *bins, *self.more_scores)

    @property
    def lacks(self) -> tuple[str, ...]:
        """Scores that the checkpoint does not give, among preference, similarity and success."""
        return tuple(name for name in ("preference", "similarity", "success") if not getattr(self, f"has_{name}"))

    @property
    def warning(self) -> str | None:
        """What everyone who sees a score must know; None: nothing."""
        return self.warning_of(self.weights_digest)

    @staticmethod
    def warning_of(weights_digest: str | None) -> str | None:
        """Return the ``warning`` about a checkpoint with these weights."""
        return TOY if weights_digest in _TOYS else None

    @property
    def remedy(self) -> str | None:
        """The command for scores without a ``warning``; None: there is none."""
        return None if self.warning is None else f"rfm serve {PUBLIC_CHECKPOINT} serves a public checkpoint"

    @property
    def weights(self) -> str | None:
        """How weights are rounded (int8, nf4), so that scores differ from the full checkpoint's; None: not rounded."""
        found = self.network.get("config", {}).get("weights")
        return found if isinstance(found, str) else None

    def to_json(self) -> str:
        """Return the description as the JSON that ``parse`` reads."""
        return json.dumps(vars(self), default=str)  # str: for a FrameSize

    @classmethod
    def parse(cls, text: str) -> Description:
        """Return the description in parameter DESCRIPTION_PARAMETER. Raises InvalidValueError."""
        expected = "the JSON object of an export"
        try:
            content = json.loads(text)
        except ValueError as error:
            raise InvalidValueError.at(_WHERE, expected, f"{text!r:.80}: {error}" if text else "none") from None
        require(_WHERE, isinstance(content, dict), expected, f"{text!r:.80}")
        kinds = typing.get_type_hints(cls)
        return cls(**{name: _read(name, value, kinds[name]) for name, value in content.items() if name in kinds})


def _read(name: str, value: Any, kind: Any) -> Any:
    """Return the field ``name`` as type ``kind``. Raises InvalidValueError for another type."""
    is_union = typing.get_origin(kind) in (types.UnionType, typing.Union)
    parts = tuple(typing.get_origin(part) or part for part in (typing.get_args(kind) if is_union else (kind,)))
    try:
        read = FrameSize.parse(value) if FrameSize in parts and isinstance(value, str) else value
        read = tuple(read) if tuple in parts and isinstance(read, list) else read
    except InvalidValueError as error:
        raise InvalidValueError.like(error, where=f"{_WHERE}: {error.where}") from None
    if not isinstance(read, parts):
        expected = " or ".join("null" if part is types.NoneType else part.__name__ for part in parts)
        raise InvalidValueError.at(f"{_WHERE}: {name}", expected, f"{value!r:.80}")
    return read


@dataclass(frozen=True, kw_only=True)
class ModelInfo(Description):
    """A served model. Facts about its checkpoint: as in ``Description`` and ``Origin``.

    versions: versions that are ready; the highest answers
    max_batch_size: most samples in a request
    by_digest: True if the model accepts frame references
    instances: how many a server runs; 0: an ensemble, whose parts have instances
    """

    name: str
    versions: tuple[str, ...]
    max_batch_size: int
    by_digest: bool = False
    instances: int = 1

    def check_scores_prefixes(self) -> None:
        """Raise InvalidSampleError if the model cannot score a running episode."""
        if self.needs_whole_episode:
            expected = "a model that scores an episode while it runs"
            got = f"{self.kind}, whose progress is relative to the whole episode: score it at its end"
            raise InvalidSampleError.at(f"model {self.name}", expected, got)

    @classmethod
    def from_config(cls, config: Mapping[str, Any], versions: Iterable[str]) -> ModelInfo:
        """Read Triton's model configuration, in the HTTP API's form. Its version policy may be that of an earlier load.

        Raises InferenceFailedError for a model without an export's description; ValueError, LookupError or TypeError
        for an answer that is not a configuration.
        """
        stored = config.get("parameters", {}).get(DESCRIPTION_PARAMETER, {})
        try:
            description = Description.parse(stored.get("string_value", ""))
        except ValueError as error:
            remedy = "export the checkpoint again with the version of rfm that serves it"
            raise InferenceFailedError(f"model {config['name']}: config.pbtxt: {error}; {remedy}") from error
        return cls(
            **vars(description),
            name=config["name"],
            versions=tuple(versions),
            max_batch_size=int(config["max_batch_size"]),
            by_digest=any(tensor["name"] == wire.FRAME_DIGESTS for tensor in config["input"]),
            instances=num_instances(config),
        )


def num_instances(config: Mapping[str, Any]) -> int:
    """Return how many instances a model has: a group has ``count`` on each of its GPUs, or on the CPU."""
    groups = config.get("instance_group", [])
    return sum(int(group.get("count", 1)) * max(len(group.get("gpus", [])), 1) for group in groups)
