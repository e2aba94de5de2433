# SPDX-License-Identifier: MIT
"""Triton's HTTP protocol over aiohttp: those methods of tritonclient's asyncio client that this package calls.

tritonclient makes the bodies of inference requests and reads the answers. Its own client would block the event loop
while it sends large arrays, and follow redirects, which would carry frames and headers to another server.
"""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from typing import Any
from urllib.parse import quote

import aiohttp
from tritonclient.http import InferenceServerClient
from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.transport.connection import SECURE_SCHEMES, Credentials
from rfm_client.transport.threads import MIN_BYTES

_AS_IT_IS = {"Accept-Encoding": "identity"}  # else aiohttp asks for gzip, which hardly shrinks floats
_HEADER_LENGTH = "Inference-Header-Content-Length"  # of the JSON before the arrays
_OK = 200


class HttpClient:
    """Connections to one server, one for each concurrent call, for one event loop.

    url: ``http://host:port`` or ``https://host:port``

    Its methods raise InferenceServerException, aiohttp's errors, InferenceFailedError for a redirect, and ValueError,
    LookupError or TypeError for an answer that is not Triton's.
    """

    def __init__(self, url: str, credentials: Credentials) -> None:
        self._url = url
        secure: dict[str, Any] = {"ssl": credentials.ssl_context} if url.startswith(SECURE_SCHEMES) else {}
        self._session = aiohttp.ClientSession(
            connector=aiohttp.TCPConnector(limit=0, **secure),
            timeout=aiohttp.ClientTimeout(),  # none: the caller has a deadline
            headers={**_AS_IT_IS, **credentials.shown},
        )

    async def infer(
        self, model_name: str, inputs: list[Any], *, outputs: list[Any], request_id: str, timeout: int
    ) -> Any:
        """Return the model's answer, tritonclient's InferResult. timeout: longest wait in Triton's queue, in us"""
        body, json_bytes = InferenceServerClient.generate_request_body(
            inputs, outputs=outputs, request_id=request_id, timeout=timeout
        )
        head = {} if json_bytes is None else {_HEADER_LENGTH: str(json_bytes)}
        answer, content = await self._checked("POST", f"models/{quote(model_name)}/infer", body, head)
        length = answer.headers.get(_HEADER_LENGTH)
        return InferenceServerClient.parse_response_body(content, header_length=length)

    async def get_server_metadata(self) -> Any:
        """Return the server's name, version and extensions."""
        return await self._json("GET", "")

    async def get_model_config(self, model_name: str) -> Any:
        """Return the configuration of the model's newest version."""
        return await self._json("GET", f"models/{quote(model_name)}/config")

    async def get_inference_statistics(self) -> Any:
        """Return the statistics of all loaded models."""
        return await self._json("GET", "models/stats")

    async def get_model_repository_index(self) -> Any:
        """Return an entry for each version of each model in the repository."""
        return await self._json("POST", "repository/index")

    async def is_server_ready(self) -> bool:
        """True if the server reports that it is ready."""
        return (await self._ask("GET", "health/ready"))[0].status == _OK

    async def is_model_ready(self, model_name: str, model_version: str = "") -> bool:
        """True if the server reports that the model, or its version, is ready."""
        version = f"/versions/{model_version}" if model_version else ""
        return (await self._ask("GET", f"models/{quote(model_name)}{version}/ready"))[0].status == _OK

    async def register_system_shared_memory(self, name: str, key: str, byte_size: int) -> None:
        """Make the server map the region ``key`` under ``name``."""
        region = json.dumps({"key": key, "offset": 0, "byte_size": byte_size})
        await self._checked("POST", f"systemsharedmemory/region/{quote(name)}/register", region.encode())

    async def unregister_system_shared_memory(self, name: str) -> None:
        """Make the server unmap a region."""
        await self._checked("POST", f"systemsharedmemory/region/{quote(name)}/unregister")

    async def close(self) -> None:
        """Close the connections, even if calls still use them."""
        await self._session.close()

    async def _json(self, method: str, path: str) -> Any:
        return json.loads((await self._checked(method, path))[1])

    async def _checked(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> tuple[aiohttp.ClientResponse, bytes]:
        answer, content = await self._ask(method, path, body, headers)
        if answer.status != _OK:
            raise InferenceServerException(_reason(content), status=str(answer.status))
        return answer, content

    async def _ask(
        self, method: str, path: str, body: bytes = b"", headers: Mapping[str, str] | None = None
    ) -> tuple[aiohttp.ClientResponse, bytes]:
        """Return an answer and its content."""
        # aiohttp sends a stream piece by piece. Large bytes would block the event loop, and aiohttp warns.
        data = io.BytesIO(body) if len(body) >= MIN_BYTES else body or None
        url = f"{self._url}/v2/{path}".rstrip("/")
        async with self._session.request(method, url, data=data, headers=headers, allow_redirects=False) as answer:
            if triton.is_redirect(answer.status):
                raise triton.redirected(self._url, answer.headers.get("Location", ""))
            return answer, await answer.read()


def _reason(content: bytes) -> str:
    """Return Triton's reason for an error; else the text of the answer, which may be a proxy's."""
    try:
        return str(json.loads(content)["error"])
    except (ValueError, LookupError, TypeError):
        return content.decode(errors="replace") or "the answer is empty"
