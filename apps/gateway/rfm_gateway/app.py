# SPDX-License-Identifier: MIT
"""The gateway as a FastAPI application."""

from __future__ import annotations

import errno
import logging
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Any

from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.encoders import jsonable_encoder
from fastapi.exceptions import RequestValidationError
from fastapi.middleware.cors import CORSMiddleware
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse
from pydantic.json_schema import models_json_schema
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from rfm_client import (
    AccessDeniedError,
    AsyncRewardClient,
    DeadlineExceededError,
    InferenceFailedError,
    ModelNotFoundError,
    RewardError,
    ServerUnavailableError,
)
from rfm_gateway import schema
from rfm_gateway.access import ForeignPageMiddleware, key_check
from rfm_gateway.body import Batch, BodyLimits, read_json, read_multipart
from rfm_gateway.config import MIB, GatewayConfig
from rfm_gateway.mounting import PageHost, add_docs, page_of
from rfm_gateway.observe import (
    CALLER_LEFT,
    REQUEST_ID_HEADER,
    RETRY_AFTER,
    CallerLeftError,
    GatewayMetrics,
    Places,
    RequestMiddleware,
    while_connected,
)
from rfm_gateway.refusals import LingerMiddleware, asked, refuse
from rfm_gateway.scoring import WARNING_HEADER, Evaluator
from rfm_gateway.state import TritonState, message_of

_REFERENCE = "#/components/schemas/{model}"
_MODELS = (schema.EvaluateBatchRequest, schema.InvalidRequest, schema.Failure)
_STATUS_OF = {  # HTTP status, by the client's error
    ServerUnavailableError: 503,
    ModelNotFoundError: 503,
    DeadlineExceededError: 504,
    InferenceFailedError: 502,
    AccessDeniedError: 502,  # the gateway's own credentials, not the caller's
}

_NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_NO_FOLDER = "No usable temporary directory"  # Python's words if none of the folders can be written at the first use
_CLOSE = {"Connection": "close"}  # the rest of the body stays unread

logger = logging.getLogger("rfm_gateway")


def create_app(
    config: GatewayConfig,
    api_key: str | None = None,
    started_by: str = "rfm-client gateway",
    *,
    client: AsyncRewardClient | None = None,
) -> FastAPI:
    """Return the application.

    api_key: key that requests must show, except for health and documentation; None: no key
    started_by: the command that a person repeats to restart this gateway
    client: for Triton; None: as ``config`` says

    Raises ValueError for a malformed URL or an unusable file.
    """
    client, metrics = client or config.client(), GatewayMetrics()
    limits = BodyLimits(config.max_body_mib * MIB, config.timeout_s)
    state = TritonState(client, config)

    @asynccontextmanager
    async def lifespan(_app: FastAPI) -> AsyncIterator[None]:
        async with client:
            yield

    title, summary = "RFM evaluation gateway", "Rewards for robot trajectories."
    app = FastAPI(
        title=title,
        summary=summary,
        lifespan=lifespan,
        docs_url=None,
        redoc_url=None,
        exception_handlers=_handlers(),
    )
    app.add_middleware(ForeignPageMiddleware, config=config, has_key=api_key is not None)  # innermost
    app.add_middleware(RequestMiddleware, metrics=metrics)
    if config.cors_origin:
        app.add_middleware(
            CORSMiddleware,
            allow_origins=config.cors_origin,
            allow_methods=["GET", "POST"],
            allow_headers=["*"],
            expose_headers=[REQUEST_ID_HEADER, WARNING_HEADER],
        )
    app.add_middleware(LingerMiddleware)  # outermost: responses are counted before it lingers
    guards = [] if api_key is None else [Depends(key_check(api_key))]
    guarded = APIRouter(dependencies=guards, responses=_failures(401) if guards else {})
    evaluator = Evaluator(
        client, limits.timeout_s, use_frame_steps=config.use_frame_steps, refuse_blank=config.refuse_blank
    )
    place = Depends(Places(config, metrics).taken)
    _add_evaluations(guarded, limits, evaluator, metrics, place)
    _add_reports(guarded, state, metrics)
    app.include_router(guarded)

    @app.get("/health", responses=_failures(502, 503, 504))
    async def health() -> schema.Health:
        """Healthy if every model answers a probe or is busy."""
        return await state.health()

    add_docs(app)
    add_page = page_of(config)
    if add_page is not None:
        add_page(PageHost(app, guards, place, config, limits, metrics, started_by))
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]  # FastAPI's way to extend it
    return app


def _add_evaluations(
    router: APIRouter, limits: BodyLimits, evaluator: Evaluator, metrics: GatewayMetrics, place: Any
) -> None:
    async def answer(request: Request, reading: Awaitable[Batch]) -> Response:
        batch = await reading
        found, warning = await while_connected(request, evaluator.evaluate(batch, request.state.request_id))
        for sample in batch.samples:
            metrics.samples.labels(sample.sample_type).inc()
        left_out = {"outputs_success"} if found.outputs_success is None else None  # clients take null for scores
        headers = {WARNING_HEADER: warning} if warning else None
        return Response(found.model_dump_json(exclude=left_out), headers=headers, media_type="application/json")

    @router.post(
        "/evaluate_batch",
        dependencies=[place],
        response_model=schema.EvaluateBatchAnswer,
        responses={422: {"model": schema.InvalidRequest}, **_failures(408, 413, 415, 502, 503, 504)},
        openapi_extra=_body("application/json", {"$ref": _REFERENCE.format(model="EvaluateBatchRequest")}),
    )
    async def evaluate_batch(request: Request) -> Response:
        """Score samples in JSON."""
        return await answer(request, read_json(limits, request))

    @router.post(
        "/evaluate_batch_npy",
        dependencies=[place],
        response_model=schema.EvaluateBatchAnswer,
        responses={422: {"model": schema.InvalidRequest}, **_failures(400, 408, 413, 415, 502, 503, 504)},
        openapi_extra=_body("multipart/form-data", _MULTIPART),
    )
    async def evaluate_batch_npy(request: Request) -> Response:
        """Score samples whose arrays are .npy files.

        The fields `sample_0`, `sample_1`, ... hold a sample each, as JSON. In it `{"__numpy_file__": name}` stands for
        the array in the part of that name.
        """
        return await answer(request, read_multipart(limits, request))


def _add_reports(router: APIRouter, state: TritonState, metrics: GatewayMetrics) -> None:
    @router.get("/gpu_status", responses=_failures(502, 503, 504))
    async def gpu_status() -> schema.GpuStatus:
        """State of the devices that models run on."""
        return await state.gpu_status()

    @router.get("/model_info", responses=_failures(502, 503, 504))
    async def model_info() -> schema.ModelInformation:
        """Facts about the served checkpoint."""
        return await state.model_info()

    @router.get("/metrics", response_class=Response, responses={200: {"content": {"text/plain": {}}}})
    async def metrics_text() -> Response:
        """The gateway's own metrics, for Prometheus."""
        return Response(metrics.text(), media_type="text/plain; version=0.0.4; charset=utf-8")


_MULTIPART = {
    "type": "object",
    "required": ["sample_0"],
    "properties": {
        "sample_0": {"type": "string", "description": "A sample as JSON; sample_1 and so on hold the others."},
        "use_frame_steps": {"type": "string", "enum": ["true", "false"]},
    },
    "additionalProperties": {"type": "string", "format": "binary", "description": "An array as a .npy file."},
}


def _body(media_type: str, content: dict[str, Any]) -> dict[str, Any]:
    return {"requestBody": {"required": True, "content": {media_type: {"schema": content}}}}


def _failures(*codes: int) -> dict[int | str, dict[str, Any]]:
    return {code: {"model": schema.Failure} for code in codes}


def _handlers() -> dict[Any, Any]:
    """Return handlers that answer every error as JSON, and never answer bad input with 500."""

    def fixed(
        code: int, detail: str, headers: Mapping[str, str] | None = None
    ) -> Callable[..., Awaitable[JSONResponse]]:
        async def handler(request: Request, _error: Exception) -> JSONResponse:
            return refuse(request.scope, code, detail, headers)

        return handler

    async def refused(request: Request, error: HTTPException) -> JSONResponse:
        return refuse(request.scope, error.status_code, error.detail, error.headers)

    async def invalid(request: Request, error: RequestValidationError) -> JSONResponse:
        return refuse(request.scope, 422, jsonable_encoder(error.errors()))

    async def failed(request: Request, error: RewardError) -> JSONResponse:
        code = next((code for kind, code in _STATUS_OF.items() if isinstance(error, kind)), 500)
        return refuse(request.scope, code, message_of(error), RETRY_AFTER if code == 503 else None)

    async def without_room(request: Request, error: OSError) -> JSONResponse:
        if error.errno not in _NO_ROOM and _NO_FOLDER not in str(error):
            raise error
        folder = f"{tempfile.tempdir} of the gateway" if tempfile.tempdir else "a temporary folder of the gateway"
        remedy = "try again, or whoever runs the gateway makes room there or names another folder in TMPDIR"
        detail = f"body: expected room in {folder}, got {error.strerror}: {remedy}"
        return refuse(request.scope, 503, detail, {**RETRY_AFTER, **_CLOSE})

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        logger.error("500 %s: unexpected", asked(request.scope), exc_info=error)
        return JSONResponse({"detail": "the gateway failed; its log has the reason"}, 500, _CLOSE)

    return {
        HTTPException: refused,
        RequestValidationError: invalid,
        TimeoutError: fixed(408, "body: expected all of it in time, got a part", _CLOSE),
        ClientDisconnect: fixed(400, "body: expected all of it, got a part"),  # the caller is gone
        CallerLeftError: fixed(CALLER_LEFT, "the caller has hung up"),  # for the log and the metrics
        RewardError: failed,
        OSError: without_room,
        Exception: unexpected,
    }


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Return the OpenAPI document, with body schemas added: endpoints read bodies from the stream, undeclared."""
    if app.openapi_schema is None:
        document = get_openapi(title=app.title, version=app.version, summary=app.summary, routes=app.routes)
        _, models = models_json_schema([(model, "validation") for model in _MODELS], ref_template=_REFERENCE)
        document["components"]["schemas"].update(models["$defs"])
        app.openapi_schema = document
    return app.openapi_schema
