"""What can be asked of a server."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Generic, TypeVar

from google.protobuf.message import Message
from grpc_health.v1.health_pb2 import HealthCheckRequest, HealthCheckResponse

from graspd import grasp_pb2 as pb

Request = TypeVar("Request", bound=Message)
Response = TypeVar("Response", bound=Message)


@dataclass(frozen=True)
class Method(Generic[Request, Response]):
    path: str
    request: type[Request]
    response: type[Response]

    def serialize(self, request: Request) -> bytes:
        return request.SerializeToString()

    def parse(self, data: bytes) -> Response:
        return self.response.FromString(data)


DETECT = Method("/grasp.v1.GraspService/DetectGrasps", pb.DetectGraspsRequest, pb.DetectGraspsResponse)
DETECT_FROM_DEPTH = Method(
    "/grasp.v1.GraspService/DetectGraspsFromDepth", pb.DetectGraspsFromDepthRequest, pb.DetectGraspsResponse
)
DETECT_FROM_CLOUD = Method(
    "/grasp.v1.GraspService/DetectGraspsFromCloud", pb.DetectGraspsFromCloudRequest, pb.DetectGraspsResponse
)
DETECT_STREAM = Method(
    "/grasp.v1.GraspService/DetectGraspsStream", pb.DetectGraspsRequest, pb.DetectGraspsStreamResponse
)
TRACK = Method("/grasp.v1.GraspService/TrackGrasps", pb.TrackGraspsRequest, pb.DetectGraspsStreamResponse)
LIST_MODELS = Method("/grasp.v1.GraspService/ListModels", pb.ListModelsRequest, pb.ListModelsResponse)
CHECK = Method("/grpc.health.v1.Health/Check", HealthCheckRequest, HealthCheckResponse)
