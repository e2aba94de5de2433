# SPDX-License-Identifier: MIT
"""tritonclient's asyncio client over HTTP, imported at first use."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping
from http import HTTPStatus
from typing import Any

from tritonclient.http.aio import InferenceServerClient
from tritonclient.utils import InferenceServerException

from rfm_client.contract import triton
from rfm_client.transport.connection import SECURE_SCHEMES, Credentials
from rfm_client.transport.threads import MIN_BYTES

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
        self._own_headers = {**_AS_IT_IS, **credentials.shown}

    async def _get(self, request_uri: str, headers: Mapping[str, Any] | None, query_params: None) -> Any:
        return await self._ask("GET", request_uri, b"", headers)

    async def _post(
        self, request_uri: str, request_body: str | bytes, headers: Mapping[str, Any] | None, query_params: None
    ) -> Any:
        body = request_body.encode() if isinstance(request_body, str) else request_body
        return await self._ask("POST", request_uri, body, headers)

    async def _ask(self, method: str, path: str, body: bytes, headers: Mapping[str, Any] | None) -> Any:
        """Return aiohttp's answer, with its content read.

        Raises InferenceFailedError for a redirect, InferenceServerException for an error other than unreadiness.
        """
        # aiohttp sends a stream piece by piece. Large bytes would block the event loop, and aiohttp warns about them.
        data = io.BytesIO(body) if len(body) >= MIN_BYTES else body or None
        every = {**self._own_headers, **self._fix_header(headers or {})}
        url = f"{self._url}/{path}"
        answer = await self._stub.request(method, url, data=data, headers=every, allow_redirects=False)
        if triton.is_redirect(answer.status):
            answer.release()
            raise triton.redirected(self._url, answer.headers.get("Location", ""))
        content = await answer.read()  # which frees the connection
        if answer.status != HTTPStatus.OK and not path.endswith("/ready"):
            raise InferenceServerException(_reason(content), status=str(answer.status))
        return answer


def _reason(content: bytes) -> str:
    """Return Triton's reason for an error; otherwise the answer's text, which may be a proxy's."""
    try:
        return str(json.loads(content)["error"])
    except (ValueError, LookupError, TypeError):
        return content.decode(errors="replace") or "the answer is empty"
