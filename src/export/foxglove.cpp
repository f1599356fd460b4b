#include "foxglove.h"

#include "protobuf.h"

namespace chainsplat::exports {

namespace {

using namespace protobuf;  // NOLINT(google-build-using-namespace): the tables below are long enough

constexpr const char *kTime = ".google.protobuf.Timestamp", *kVector = ".foxglove.Vector3";

// https://github.com/foxglove/foxglove-sdk, schemas/proto: numbers and types of the fields are an interface.
std::vector<File> files() {
  const File time{"google/protobuf/timestamp.proto",
                  "google.protobuf",
                  {},
                  {{"Timestamp", {{1, "seconds", Type::int64}, {2, "nanos", Type::int32}}}}};
  const std::vector<Field> xyz{{1, "x", Type::real}, {2, "y", Type::real}, {3, "z", Type::real}};
  std::vector<Field> xyzw = xyz;
  xyzw.push_back({4, "w", Type::real});
  const Field at{1, "timestamp", Type::message, kTime};
  const File foxglove{
      "foxglove/rope.proto",
      "foxglove",
      {time.name},
      {{"Vector3", xyz},
       {"Point3", xyz},
       {"Quaternion", xyzw},
       {"Pose", {{1, "position", Type::message, kVector}, {2, "orientation", Type::message, ".foxglove.Quaternion"}}},
       {"Color", {{1, "r", Type::real}, {2, "g", Type::real}, {3, "b", Type::real}, {4, "a", Type::real}}},
       {"FrameTransform",
        {at,
         {2, "parent_frame_id", Type::text},
         {3, "child_frame_id", Type::text},
         {4, "translation", Type::message, kVector},
         {5, "rotation", Type::message, ".foxglove.Quaternion"}}},
       {"FrameTransforms", {{1, "transforms", Type::message, ".foxglove.FrameTransform", true}}},
       {"JointState", {{1, "name", Type::text}, {2, "position", Type::real}, {3, "velocity", Type::real}}},
       {"JointStates", {at, {2, "joints", Type::message, ".foxglove.JointState", true}}},
       {"PosesInFrame", {at, {2, "frame_id", Type::text}, {3, "poses", Type::message, ".foxglove.Pose", true}}},
       {"LinePrimitive",
        {{1, "type", Type::enumeration, ".foxglove.LinePrimitive.Type"},
         {2, "pose", Type::message, ".foxglove.Pose"},
         {3, "thickness", Type::real},
         {4, "scale_invariant", Type::boolean},
         {5, "points", Type::message, ".foxglove.Point3", true},
         {6, "color", Type::message, ".foxglove.Color"}},
        {{"Type", {"LINE_STRIP", "LINE_LOOP", "LINE_LIST"}}}},
       {"SceneEntity",
        {at,
         {2, "frame_id", Type::text},
         {3, "id", Type::text},
         {5, "frame_locked", Type::boolean},
         {11, "lines", Type::message, ".foxglove.LinePrimitive", true}}},
       {"SceneUpdate", {{2, "entities", Type::message, ".foxglove.SceneEntity", true}}},
       {"PackedElementField",
        {{1, "name", Type::text},
         {2, "offset", Type::fixed32},
         {3, "type", Type::enumeration, ".foxglove.PackedElementField.NumericType"}},
        {{"NumericType", {"UNKNOWN", "UINT8", "INT8", "UINT16", "INT16", "UINT32", "INT32", "FLOAT32", "FLOAT64"}}}},
       {"PointCloud",
        {at,
         {2, "frame_id", Type::text},
         {3, "pose", Type::message, ".foxglove.Pose"},
         {4, "point_stride", Type::fixed32},
         {5, "fields", Type::message, ".foxglove.PackedElementField", true},
         {6, "data", Type::bytes}}},
       {"CameraCalibration",
        {at,
         {2, "width", Type::fixed32},
         {3, "height", Type::fixed32},
         {4, "distortion_model", Type::text},
         {5, "D", Type::real, "", true},
         {6, "K", Type::real, "", true},
         {7, "R", Type::real, "", true},
         {8, "P", Type::real, "", true},
         {9, "frame_id", Type::text}}},
       {"CompressedImage", {at, {2, "data", Type::bytes}, {3, "format", Type::text}, {4, "frame_id", Type::text}}}}};
  const File ours{
      "chainsplat/rope.proto",
      "chainsplat",
      {time.name, foxglove.name},
      {{"Wrench",
        {at,
         {2, "frame_id", Type::text},
         {3, "force", Type::message, kVector},
         {4, "torque", Type::message, kVector},
         {5, "unit", Type::text}}},
       {"Force",
        {at,
         {2, "frame_id", Type::text},
         {3, "point", Type::message, kVector},
         {4, "force", Type::message, kVector},
         {5, "sigma", Type::message, kVector},
         {6, "touching", Type::boolean},
         {7, "unit", Type::text}}},
       {"Status", {at, {2, "status", Type::text}, {3, "centerline_sigma", Type::real}, {4, "latency", Type::real}}}}};
  return {time, foxglove, ours};
}

}  // namespace

const std::string& foxglove_descriptors() {
  static const std::string bytes = descriptor_set(files());
  return bytes;
}

}  // namespace chainsplat::exports
