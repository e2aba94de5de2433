# SPDX-License-Identifier: MIT
"""The wire contract: samples and results as named tensors.

Letters: B samples of one request (the batch axis), P frame positions: the first trajectory's frames, then
the second's, then zero padding; D, Dt, K, H, W as in ``rfm_client.contract.samples``.

Whatever changes the answer is an input, and every input but two is always present: that is what lets Triton put
requests of different callers, lengths and sample types into one batch. The two are optional; Triton batches requests
that have one among themselves:

- ``second_frames``, for pairs whose trajectories differ in frame size: ``frames`` then holds the first trajectories
  alone, and it the second ones. P is then the positions of both arrays.
- ``frame_digests``, of a model that keeps what it made of frames: the name of each of the P frames (``named_frames``).
  ``frames`` then holds, in any order and in any sample's row, the pixels of those that the model may not know; zeros
  may lie between them. A request with a digest that the model does not know is refused, and its caller asks again with
  all pixels.
"""

from rfm_client.contract.wire.results import *  # noqa: F403
from rfm_client.contract.wire.samples import *  # noqa: F403
from rfm_client.contract.wire.specs import *  # noqa: F403
