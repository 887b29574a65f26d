"""Tests a client generated from the .proto file against the server at GRASPD_SERVER, which serves the model "mirror"
with --max-tracked 4.

The crate grasp-tests (tests/it/python.rs) starts that server and runs this file. To run it separately:
    GRASPD_SERVER=127.0.0.1:50051 GRASPD_PROTO=proto/proto python -m unittest discover tests/python
"""

import os
import sys
import tempfile
import threading
import time
import unittest
from importlib import import_module

import grpc
import numpy as np
from google.protobuf.descriptor_pool import DescriptorPool
from grpc_health.v1 import health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection_pb2
from grpc_reflection.v1alpha.proto_reflection_descriptor_database import ProtoReflectionDescriptorDatabase
from grpc_tools import protoc

SERVICES = {
    "grasp.v1.GraspService",
    "grpc.health.v1.Health",
    "grpc.reflection.v1.ServerReflection",
    "grpc.reflection.v1alpha.ServerReflection",
    "inference.GRPCInferenceService",
}
RESOLUTION = 16
VOXEL_SIZE = 0.3 / RESOLUTION
CENTRES = [(4, 5, 6), (11, 10, 9)]


def generate(folder):
    """Returns the modules that protoc generates from the .proto file."""
    proto = os.environ["GRASPD_PROTO"]
    # grpcio-tools contains the well-known types.
    well_known = os.path.join(os.path.dirname(protoc.__file__), "_proto")
    arguments = ["protoc", f"-I{proto}", f"-I{well_known}", f"--python_out={folder}", f"--grpc_python_out={folder}"]
    if protoc.main([*arguments, "grasp/v1/grasp.proto"]):
        raise RuntimeError("protoc rejects the .proto file")
    sys.path.insert(0, folder)
    return import_module("grasp.v1.grasp_pb2"), import_module("grasp.v1.grasp_pb2_grpc")


def blobs():
    """Free space with a block of 5³ voxels of value 1 around each centre. The model "mirror" has a grasp at each."""
    volume = np.full((RESOLUTION,) * 3, 0.6, np.float32)
    for x, y, z in CENTRES:
        volume[x - 2 : x + 3, y - 2 : y + 3, z - 2 : z + 3] = 1.0
    return volume


class ClientTest(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        folder = tempfile.TemporaryDirectory()
        cls.addClassCleanup(folder.cleanup)
        cls.pb, services = generate(folder.name)
        cls.channel = grpc.insecure_channel(os.environ["GRASPD_SERVER"])
        cls.addClassCleanup(cls.channel.close)
        cls.grasps = services.GraspServiceStub(cls.channel)

    def volume(self, values=None, dtype=None):
        values = blobs() if values is None else values
        dtype = self.pb.DATA_TYPE_F32 if dtype is None else dtype
        return self.pb.Volume(data=values.tobytes(), dtype=dtype, resolution=RESOLUTION, voxel_size=VOXEL_SIZE)

    def request(self, volume=None, **fields):
        return self.pb.DetectGraspsRequest(volume=volume or self.volume(), **fields)

    def positions(self, response):
        return sorted((g.pose.position.x, g.pose.position.y, g.pose.position.z) for g in response.grasps)

    def test_the_grasps_are_where_the_blobs_are(self):
        expected = [[c * VOXEL_SIZE for c in centre] for centre in CENTRES]
        pb, values = self.pb, blobs()
        for volume in [
            self.volume(values, pb.DATA_TYPE_F32),
            self.volume(values.astype("<f2"), pb.DATA_TYPE_F16),
            self.volume(np.rint(values * 255).astype(np.uint8), pb.DATA_TYPE_U8),
        ]:
            response = self.grasps.DetectGrasps(self.request(volume, request_id="from python"))
            np.testing.assert_allclose(self.positions(response), expected, atol=1e-9)
            self.assertEqual((response.request_id, response.model, response.version), ("from python", "mirror", "1"))
            self.assertGreater(response.latency.total, 0)

    def test_grasps_are_in_the_frame_of_the_volumes_pose(self):
        volume = self.volume()
        volume.frame_id = "base"
        volume.pose.position.x = 0.5
        volume.pose.orientation.w = 1.0
        response = self.grasps.DetectGrasps(self.request(volume))
        moved = [(x - 0.5, y, z) for x, y, z in self.positions(response)]
        np.testing.assert_allclose(moved, self.positions(self.grasps.DetectGrasps(self.request())), atol=1e-9)
        self.assertEqual(response.frame_id, "base")

    def test_explain_accounts_for_every_voxel(self):
        response = self.grasps.DetectGrasps(self.request(options=self.pb.Options(explain=True)))
        dropped = sum(value for _, value in response.dropped.ListFields())
        self.assertEqual(dropped + len(response.grasps), RESOLUTION**3)

    def test_replies_of_a_stream_are_in_order(self):
        requests = [self.request(request_id=str(i), options=self.pb.Options(model="missing" if i == 3 else "")) for i in range(8)]
        replies = list(self.grasps.DetectGraspsStream(iter(requests)))
        self.assertEqual([reply.request_id for reply in replies], [str(i) for i in range(8)])
        for index, reply in enumerate(replies):
            self.assertEqual(reply.WhichOneof("outcome"), "error" if index == 3 else "response")
        self.assertEqual(replies[3].error.code, grpc.StatusCode.NOT_FOUND.value[0])

    def test_streams_that_are_refused_while_they_send_have_the_status_of_the_refusal(self):
        sending = threading.Event()
        self.addCleanup(sending.set)

        def requests():
            for _ in range(20):
                yield self.pb.TrackGraspsRequest(workspace=self.pb.Workspace(frame_id="x" * 200))
            sending.wait()

        calls = [self.grasps.TrackGrasps(requests()) for _ in range(60)]
        self.addCleanup(lambda: [call.cancel() for call in calls])
        deadline = time.monotonic() + 20
        while sum(not call.is_active() for call in calls) < 56 and time.monotonic() < deadline:
            time.sleep(0.05)
        ended = [call.code() for call in calls if not call.is_active()]
        self.assertEqual(ended, [grpc.StatusCode.RESOURCE_EXHAUSTED] * 56)

    def test_errors_have_their_status_code(self):
        values = blobs()
        values[1, 2, 3] = np.nan
        index = np.ravel_multi_index((1, 2, 3), values.shape)
        for request, code, message in [
            (self.request(self.volume(values)), grpc.StatusCode.INVALID_ARGUMENT, f"volume.data[{index}] is NaN"),
            (self.request(options=self.pb.Options(model="missing")), grpc.StatusCode.NOT_FOUND, "available: mirror 1"),
        ]:
            with self.assertRaises(grpc.RpcError) as caught:
                self.grasps.DetectGrasps(request)
            self.assertEqual(caught.exception.code(), code)
            self.assertIn(message, caught.exception.details())

    def test_models_are_listed(self):
        model, shaf = self.grasps.ListModels(self.pb.ListModelsRequest()).models
        self.assertEqual((shaf.name, shaf.resolution), ("shaf", 0))
        self.assertEqual((model.name, model.version, model.resolution), ("mirror", "1", RESOLUTION))

    def test_health(self):
        health = health_pb2_grpc.HealthStub(self.channel)
        for service in ["", "grasp.v1.GraspService", "inference.GRPCInferenceService"]:
            response = health.Check(health_pb2.HealthCheckRequest(service=service))
            self.assertEqual(response.status, health_pb2.HealthCheckResponse.SERVING)

    def test_reflection_lists_and_describes_the_services(self):
        database = ProtoReflectionDescriptorDatabase(self.channel)
        self.assertEqual(set(database.get_services()), SERVICES - {"grpc.reflection.v1.ServerReflection"})
        service = DescriptorPool(database).FindServiceByName("grasp.v1.GraspService")
        self.assertLessEqual({"DetectGrasps", "DetectGraspsFromDepth", "TrackGrasps"}, set(service.methods_by_name))

    def test_reflection_v1(self):
        # grpcio-reflection implements v1alpha; the messages of v1 are the same.
        call = self.channel.stream_stream(
            "/grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
            reflection_pb2.ServerReflectionRequest.SerializeToString,
            reflection_pb2.ServerReflectionResponse.FromString,
        )
        (response,) = call(iter([reflection_pb2.ServerReflectionRequest(list_services="")]))
        listed = {service.name for service in response.list_services_response.service}
        self.assertEqual(listed, SERVICES - {"grpc.reflection.v1alpha.ServerReflection"})


if __name__ == "__main__":
    unittest.main()
