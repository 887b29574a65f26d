"""The RPC methods with their message types."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import Message
from grpc_health.v1.health_pb2 import HealthCheckRequest, HealthCheckResponse

from graspd import grasp_pb2 as pb
from graspd import wire

Request = TypeVar("Request", bound=Message)
Response = TypeVar("Response", bound=Message)
Answer = TypeVar("Answer")


@dataclass(frozen=True)
class Method(Generic[Request, Response, Answer]):
    path: str
    request: type[Request]
    response: type[Response]
    answer: Callable[[Response], Answer]
    """Converts a response to the result of the client's method."""

    def serialize(self, request: Request) -> bytes:
        return request.SerializeToString()

    def parse(self, data: bytes) -> Response:
        return self.response.FromString(data)


GRASPS = "/grasp.v1.GraspService/"
DETECT = Method(GRASPS + "DetectGrasps", pb.DetectGraspsRequest, pb.DetectGraspsResponse, wire.detection)
DETECT_FROM_DEPTH = Method(
    GRASPS + "DetectGraspsFromDepth", pb.DetectGraspsFromDepthRequest, pb.DetectGraspsResponse, wire.detection
)
DETECT_FROM_CLOUD = Method(
    GRASPS + "DetectGraspsFromCloud", pb.DetectGraspsFromCloudRequest, pb.DetectGraspsResponse, wire.detection
)
DETECT_STREAM = Method(
    GRASPS + "DetectGraspsStream", pb.DetectGraspsRequest, pb.DetectGraspsStreamResponse, wire.outcome
)
TRACK = Method(GRASPS + "TrackGrasps", pb.TrackGraspsRequest, pb.DetectGraspsStreamResponse, wire.outcome)
SCORE = Method(GRASPS + "ScoreGrasps", pb.ScoreGraspsRequest, pb.ScoreGraspsResponse, wire.scores)
FIND_TABLE = Method(GRASPS + "FindTable", pb.FindTableRequest, pb.FindTableResponse, wire.found_table)
LIST_MODELS = Method(GRASPS + "ListModels", pb.ListModelsRequest, pb.ListModelsResponse, wire.models)
CHECK = Method("/grpc.health.v1.Health/Check", HealthCheckRequest, HealthCheckResponse, wire.is_serving)
