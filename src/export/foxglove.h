// foxglove.h - the messages of a recording: Foxglove's, as far as we write them, and three of ours.
#pragma once
#include <string>

namespace chainsplat::exports {

// Full names of messages.
inline constexpr const char* kFrameTransforms = "foxglove.FrameTransforms";
inline constexpr const char* kJointStates = "foxglove.JointStates";
inline constexpr const char* kPosesInFrame = "foxglove.PosesInFrame";
inline constexpr const char* kSceneUpdate = "foxglove.SceneUpdate";
inline constexpr const char* kPointCloud = "foxglove.PointCloud";
inline constexpr const char* kCameraCalibration = "foxglove.CameraCalibration";
inline constexpr const char* kCompressedImage = "foxglove.CompressedImage";
inline constexpr const char* kWrench = "chainsplat.Wrench";
inline constexpr const char* kForce = "chainsplat.Force";
inline constexpr const char* kStatus = "chainsplat.Status";

// What describes them all, a FileDescriptorSet.
const std::string& foxglove_descriptors();

}  // namespace chainsplat::exports
