# SPDX-License-Identifier: MIT
"""tritonclient's asyncio client over gRPC, imported at first use."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from functools import lru_cache
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
from tritonclient.grpc import aio, service_pb2
from tritonclient.utils import InferenceServerException, np_to_triton_dtype, serialize_byte_tensor, triton_to_np_dtype

from rfm_client.contract.wire import Tensors
from rfm_client.transport.connection import Credentials, grpc_options
from rfm_client.transport.shared_memory import Region
from rfm_client.transport.threads import off_loop

_INFER = "/inference.GRPCInferenceService/ModelInfer"
_RAW_INPUT = b"\x3a"  # in protobuf's encoding, begins an entry of ``raw_input_contents``; its length and bytes follow
_HEADS = 256  # how many requests' heads to keep

Input: TypeAlias = tuple[str, tuple[int, ...], "np.dtype[Any]", str]  # name, shape, dtype, and region or nothing


class GrpcClient(aio.InferenceServerClient):  # type: ignore[misc]  # untyped
    """A connection to one server, for one event loop. The caller has a deadline.

    Unlike the base class, this client copies each tensor into the request once, instead of three times, and makes the
    head of a request only if its shapes are new.
    """

    def __init__(self, scheme: str, address: str, credentials: Credentials) -> None:
        super().__init__(address, channel_args=grpc_options(address), **credentials.grpc_options(scheme))
        credentials.show_with_each_request(self)
        decode = service_pb2.ModelInferResponse.FromString
        self._model_infer = self._channel.unary_unary(_INFER, response_deserializer=decode)

    async def score(
        self,
        model: str,
        inputs: Tensors,
        regions: Mapping[str, Region],
        outputs: Collection[str],
        request_id: str,
        waits_us: int,
    ) -> tuple[Tensors, str]:
        """Return the named outputs that the model gave, and its version. Arguments as in ``TritonTransport.infer``.

        regions: shared memory with inputs
        waits_us: how long the request may wait in Triton's queue
        """
        one = service_pb2.ModelInferRequest(id=request_id)
        one.parameters["timeout"].int64_param = waits_us
        described = tuple(
            (name, a.shape, a.dtype, regions[name].name if name in regions else "") for name, a in inputs.items()
        )
        head = _head(model, described, tuple(outputs)) + one.SerializeToString()
        sent = [array for name, array in inputs.items() if name not in regions]
        request = await off_loop(sum(array.nbytes for array in sent), _request, head, sent)
        try:
            response = await self._model_infer(request, metadata=self._get_metadata(None))
        except aio.grpc.RpcError as error:  # of the grpc that tritonclient brings
            raise InferenceServerException(error.details(), str(error.code())) from None
        arrays = {
            output.name: np.frombuffer(content, triton_to_np_dtype(output.datatype)).reshape(tuple(output.shape))
            for output, content in zip(response.outputs, response.raw_output_contents, strict=True)
        }
        return arrays, response.model_version


@lru_cache(_HEADS)
def _head(model: str, inputs: tuple[Input, ...], outputs: tuple[str, ...]) -> bytes:
    """Return the part of a request that all requests of the same shapes share, in protobuf's encoding."""
    head = service_pb2.ModelInferRequest(model_name=model)
    for name, shape, dtype, region in inputs:
        tensor = head.inputs.add(name=name, shape=shape, datatype=np_to_triton_dtype(dtype))
        if region:
            tensor.parameters["shared_memory_region"].string_param = region
            tensor.parameters["shared_memory_byte_size"].int64_param = math.prod(shape) * dtype.itemsize
    for name in outputs:
        head.outputs.add(name=name)
    return bytes(head.SerializeToString())


def _request(head: bytes, arrays: Collection[npt.NDArray[Any]]) -> bytes:
    """Return a request. In protobuf's encoding, fields may follow each other in any order and several parts."""
    parts: list[Any] = [head]
    for array in arrays:
        content = serialize_byte_tensor(array).item() if array.dtype == object else np.ascontiguousarray(array).data
        parts += (_RAW_INPUT, _varint(memoryview(content).nbytes), content)
    return b"".join(parts)


def _varint(number: int) -> bytes:
    """Return the number in protobuf's encoding: seven bits a byte, the lowest first. All bytes but the last add 128."""
    encoded = bytearray()
    while number > 127:
        encoded.append(number & 127 | 128)
        number >>= 7
    return bytes([*encoded, number])
