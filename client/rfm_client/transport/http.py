# SPDX-License-Identifier: MIT
"""tritonclient's asyncio client over HTTP, imported at first use."""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Mapping
from http import HTTPStatus
from typing import Any
from urllib.parse import urljoin

from tritonclient.http import InferInput, InferRequestedOutput
from tritonclient.http.aio import InferenceServerClient
from tritonclient.utils import InferenceServerException, np_to_triton_dtype

from rfm_client.contract.errors import InferenceFailedError
from rfm_client.contract.triton import over_http
from rfm_client.contract.wire import Tensors
from rfm_client.transport.connection import SECURE_SCHEMES, Credentials
from rfm_client.transport.shared_memory import Region
from rfm_client.transport.threads import off_loop

_REDIRECTS = range(300, 400)
_AS_IT_IS = {"Accept-Encoding": "identity"}  # otherwise aiohttp asks for gzip, which hardly shrinks floats


class HttpClient(InferenceServerClient):  # type: ignore[misc]  # untyped
    """Connections to one server, one for each concurrent call, for one event loop. The caller has a deadline.

    Unlike the base class, this client does not block the event loop while sending large arrays. It follows no redirect,
    which would carry frames and headers to another server.
    """

    def __init__(self, scheme: str, address: str, credentials: Credentials) -> None:
        is_secure = scheme in SECURE_SCHEMES
        context = credentials.ssl_context if is_secure else None
        super().__init__(address, conn_limit=0, conn_timeout=None, ssl=is_secure, ssl_context=context)
        self._own_headers = {**_AS_IT_IS, **over_http(credentials.shown)}

    async def score(
        self,
        model: str,
        inputs: Tensors,
        regions: Mapping[str, Region],
        outputs: Collection[str],
        request_id: str,
        waits_us: int,
    ) -> tuple[Tensors, str]:
        """Return the named outputs that the model gave, and its version, as ``GrpcClient.score`` does."""
        requested = [InferRequestedOutput(name) for name in outputs]
        num_bytes = sum(array.nbytes for name, array in inputs.items() if name not in regions)
        tensors = await off_loop(num_bytes, _tensors, inputs, regions)
        answer = await self.infer(model, tensors, outputs=requested, request_id=request_id, timeout=waits_us)
        arrays = {name: answer.as_numpy(name) for name in outputs}
        return {name: array for name, array in arrays.items() if array is not None}, answer.get_response()[
            "model_version"
        ]

    async def _get(self, request_uri: str, headers: Mapping[str, Any] | None, query_params: None) -> Any:
        return await self._ask("GET", request_uri, b"", headers)

    async def _post(
        self, request_uri: str, request_body: str | bytes, headers: Mapping[str, Any] | None, query_params: None
    ) -> Any:
        body = request_body.encode() if isinstance(request_body, str) else request_body
        return await self._ask("POST", request_uri, body, headers)

    async def _ask(self, method: str, path: str, body: bytes, headers: Mapping[str, Any] | None) -> Any:
        """Return aiohttp's answer, with its content read.

        Raises InferenceFailedError for a redirect and for another server than Triton, InferenceServerException for an
        error other than unreadiness.
        """
        # aiohttp sends a stream piece by piece. Bytes block the event loop, and from a MiB on it warns about them.
        data = io.BytesIO(body) if len(body) >= 2**20 else body or None
        every = {**self._own_headers, **self._fix_header(headers or {})}
        url = f"{self._url}/{path}"
        answer = await self._stub.request(method, url, data=data, headers=every, allow_redirects=False)
        if answer.status in _REDIRECTS:
            answer.release()
            target = urljoin(url, answer.headers.get("Location", ""))
            raise InferenceFailedError(
                f"{self._url}: expected an answer of Triton, got a redirect to {target!r:.200}: give that server's "
                "address as URL if you trust it"
            )
        content = await answer.read()  # which frees the connection
        if answer.status != HTTPStatus.OK and not path.endswith("/ready"):
            raise _error(self._url, answer.status, content)
        return answer


def _tensors(inputs: Tensors, regions: Mapping[str, Region]) -> list[InferInput]:
    tensors = []
    for name, array in inputs.items():
        tensor = InferInput(name, array.shape, np_to_triton_dtype(array.dtype))
        if name in regions:
            tensor.set_shared_memory(regions[name].name, array.nbytes)
        else:
            tensor.set_data_from_numpy(array)
        tensors.append(tensor)
    return tensors


def _error(url: str, status: int, content: bytes) -> Any:
    """Return the error with Triton's reason; otherwise with the answer's text, which may be a proxy's."""
    try:
        reason = str(json.loads(content)["error"])
    except (ValueError, LookupError, TypeError):
        if status == HTTPStatus.NOT_FOUND:
            expected = "Triton's HTTP port (by default 8000)"
            return InferenceFailedError(f"{url}: expected {expected}, got a server without Triton's pages (404)")
        reason = content.decode(errors="replace") or "the answer is empty"
    return InferenceServerException(reason, status=str(status))
