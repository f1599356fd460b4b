// Calibrations by format. Conventions of each, which notes repeat to the user:
//   OpenCV, ROS, Kalibr: pixel (0, 0) is centered at (0, 0), so half a pixel is added to the center
//   COLMAP, nerfstudio, ours: at (0.5, 0.5)
//   Kalibr's T_a_b takes b's coordinates to a; rvec and tvec of OpenCV take the world's to the camera
//   nerfstudio's transform_matrix takes the camera's to the world, with OpenGL's axes
#include "calibration.h"

#include <algorithm>
#include <cmath>

#include "document.h"

namespace chainsplat::importing {

using math::Matrix3;
using math::MatrixX;
using math::Pose;
using math::Vector3;

namespace {

constexpr double kRotationTolerance = 1e-2;        // of |R R^T - I|; the capture's reader is stricter, after cleaning
constexpr double kQuaternionNormTolerance = 1e-2;  // of its length

InputError wrong(const Source& source, const std::string& what, const std::string& mend) {
  return {source.file.string() + (source.key.empty() ? "" : "#" + source.key), what, mend};
}

std::vector<std::string> keys_of(const Json& object) {
  std::vector<std::string> out;
  if (object.is_object())
    for (const auto& item : object.items()) out.push_back(item.key());
  return out;
}

// The part of the document that is meant: what the key names, else what is named as the camera, else all of it.
const Json& part_of(const Json& document, const Source& source, const std::string& camera) {
  if (!source.key.empty()) {
    if (const Json* part = find_path(document, source.key)) return *part;
    // a list of entries that have a name
    for (const Json* entries : {&document, find(document, {"cameras"})})
      if (entries && entries->is_array())
        for (const Json& entry : *entries)
          if (const Json* name = find(entry, {"name", "camera_name", "id", "serial"}))
            if ((name->is_string() ? name->get<std::string>() : name->dump()) == source.key) return entry;
    if (const Json* cameras = find(document, {"cameras"}))
      if (const Json* part = find_path(*cameras, source.key)) return *part;
    throw wrong(source, "has no key '" + source.key + "'", "it has " + list_of(keys_of(document)));
  }
  if (const Json* part = find_path(document, camera); part && part->is_object()) return *part;
  if (const Json* cameras = find(document, {"cameras"})) {
    if (const Json* part = find_path(*cameras, camera); part && part->is_object()) return *part;
    if (cameras->is_array()) {
      for (const Json& entry : *cameras)
        if (const Json* name = find(entry, {"name", "camera_name", "id"}); name && name->is_string() && *name == camera)
          return entry;
      if (cameras->size() == 1) return (*cameras)[0];
    }
  }
  return document;
}

enum class Side { none, camera, world };

Side side_of(const std::string& word, const std::string& camera) {
  for (const char* name : {"c", "cam", "camera", "optical", "sensor", "rgb", "color", "view", "eye"})
    if (word == name) return Side::camera;
  for (const std::string& own : words(camera))
    if (word == own) return Side::camera;
  if ((word.starts_with("cam") || word.starts_with("c")) && word.find_first_of("0123456789") != std::string::npos)
    return Side::camera;
  for (const char* name : {"w", "world", "b", "base", "robot", "map", "o", "origin", "global", "root", "board",
                           "target", "tag", "marker", "link0", "object", "g"})
    if (word == name) return Side::world;
  return Side::none;
}

// Which way the matrix maps that a file calls so: T_a_b, a_T_b and a_from_b take b's coordinates to a, a2b, a_to_b and
// a_in_b the other way.
Direction direction_by(const std::string& key, const std::string& camera) {
  bool to = false;
  std::vector<std::string> parts;
  const bool short_name = key.size() == 3 && key[1] == 'T';  // cTw
  for (const std::string& word : words(short_name ? std::string{key[0], ' ', key[2]} : key)) {
    const std::size_t two = word.find('2');
    if (two != std::string::npos && two > 0 && two + 1 < word.size() && !std::isdigit(word[two + 1])) {
      parts.push_back(word.substr(0, two)), parts.push_back(word.substr(two + 1));
      to = true;
    } else if (word.size() == 2 && side_of(word.substr(0, 1), "") != Side::none &&
               side_of(word.substr(1), "") != Side::none) {  // T_wc
      parts.push_back(word.substr(0, 1)), parts.push_back(word.substr(1));
    } else {
      to = to || word == "to" || word == "in";
      parts.push_back(word);
    }
  }
  std::vector<Side> sides;
  for (const std::string& word : parts)
    if (const Side side = side_of(word, camera); side != Side::none && (sides.empty() || sides.back() != side))
      sides.push_back(side);
  if (sides.size() != 2) return Direction::open;
  const bool camera_first = sides[0] == Side::camera;
  return camera_first == to ? Direction::world_from_camera : Direction::camera_from_world;
}

std::optional<Vector3> vector3(const Json* value) {
  if (!value) return std::nullopt;
  if (value->is_object() && find(*value, {"x"})) {
    const auto x = number(find(*value, {"x"})), y = number(find(*value, {"y"})), z = number(find(*value, {"z"}));
    if (x && y && z) return Vector3(*x, *y, *z);
  }
  const auto m = matrix(*value);
  if (!m || m->size() != 3) return std::nullopt;
  return Vector3(m->data()[0], m->data()[1], m->data()[2]);
}

std::optional<Eigen::Quaterniond> quaternion(const Json* value) {
  if (!value) return std::nullopt;
  for (const char* prefix : {"", "q"}) {
    const auto part = [&](const char* name) { return number(find(*value, {(std::string(prefix) + name).c_str()})); };
    const auto x = part("x"), y = part("y"), z = part("z"), w = part("w");
    if (x && y && z && w) return Eigen::Quaterniond(*w, *x, *y, *z);
  }
  return std::nullopt;
}

std::optional<FoundPose> pose_by_parts(const Json& entry, const std::string& where) {
  // OpenCV's vectors take the world to the camera
  const auto rvec = vector3(find(entry, {"rvec", "rotation_vector", "r_vec", "rvecs"}));
  const auto tvec = vector3(find(entry, {"tvec", "translation_vector", "t_vec", "tvecs", "t", "translation"}));
  if (rvec && tvec)
    return FoundPose{{math::exp_so3(*rvec), *tvec}, Direction::camera_from_world, Axes::opencv, where + ": rvec, tvec"};
  // position and quaternion are where the camera is, as of tf and hand-eye programs
  const Json* rotation = find(entry, {"rotation", "orientation", "quaternion"});
  const auto place = vector3(find(entry, {"translation", "position", "xyz"}));
  if (const auto q = quaternion(rotation); q && place)
    if (const auto pose = rigid(*place, *q))
      return FoundPose{*pose, Direction::world_from_camera, Axes::opencv, where + ": position and quaternion"};
  if (const auto q = quaternion(&entry); q && vector3(&entry))
    if (const auto pose = rigid(*vector3(&entry), *q))
      return FoundPose{*pose, Direction::world_from_camera, Axes::opencv, where + ": x, y, z, qx, qy, qz, qw"};
  if (const Json* q = find(entry, {"quaternion_xyzw", "quat_xyzw", "xyzw"}); q && place)
    if (const auto v = list(q); v && v->size() == 4)
      if (const auto pose = rigid(*place, Eigen::Quaterniond((*v)[3], (*v)[0], (*v)[1], (*v)[2])))
        return FoundPose{*pose, Direction::world_from_camera, Axes::opencv, where + ": position and quaternion"};
  // a rotation matrix beside a vector: OpenCV's R and T, mostly camera from world, but not always
  const Json* turn = find(entry, {"R", "rotation_matrix", "rmat", "rotation"});
  if (const auto m = turn ? matrix(*turn) : std::nullopt; m && m->rows() == 3 && m->cols() == 3)
    if (const auto t = vector3(find(entry, {"T", "t", "translation", "tvec", "translation_vector", "position"}))) {
      MatrixX both(3, 4);
      both << *m, *t;
      if (const auto pose = rigid(both)) return FoundPose{*pose, Direction::open, Axes::opencv, where + ": R and T"};
    }
  return std::nullopt;
}

// Of several poses the one that is called as the camera, else the one whose direction is clear.
std::optional<FoundPose> choose(std::vector<std::pair<std::string, FoundPose>> all, const std::string& where,
                                const std::string& camera) {
  std::vector<std::pair<std::string, FoundPose>> own;
  for (const auto& one : all)
    if (!camera.empty() && lower(one.first).find(lower(camera)) != std::string::npos) own.push_back(one);
  if (!own.empty()) all = own;
  for (const Direction direction : {Direction::world_from_camera, Direction::camera_from_world, Direction::open}) {
    std::vector<std::string> names;
    std::optional<FoundPose> found;
    for (const auto& [name, pose] : all)
      if (pose.direction == direction) names.push_back(name), found = pose;
    if (names.size() > 1) throw InputError(where, "holds several poses: " + list_of(names), "name one with #KEY");
    if (found) return found;
  }
  return std::nullopt;
}

// A pose in an entry of a document: by parts, or a matrix that is a rigid motion, or in an object inside.
std::optional<FoundPose> find_pose(const Json& entry, const std::string& where, const std::string& camera) {
  if (const auto m = matrix(entry))
    if (const auto pose = rigid(*m)) return FoundPose{*pose, Direction::open, Axes::opencv, where};
  if (!entry.is_object()) return std::nullopt;
  if (auto found = pose_by_parts(entry, where)) return found;
  std::vector<std::pair<std::string, FoundPose>> matrices, inside;
  for (const auto& item : entry.items()) {
    const std::string name = lower(item.key());
    if (name.find("imu") != std::string::npos || name.find("cnm1") != std::string::npos) continue;  // not the world's
    const std::string place = where + ": " + item.key();
    const Direction direction = direction_by(item.key(), camera);
    const auto m = matrix(item.value());
    if (const auto pose = m && m->cols() == 4 ? rigid(*m) : std::nullopt) {
      matrices.push_back({item.key(), {*pose, direction, Axes::opencv, place}});
    } else if (item.value().is_object() && !m) {
      auto found = find_pose(item.value(), place, camera);
      if (!found) continue;
      if (direction != Direction::open) found->direction = direction;
      inside.push_back({item.key(), *found});
    }
  }
  if (auto found = choose(matrices, where, camera)) return found;
  return choose(inside, where, camera);
}

// A size of an image, px; 0 where it is none.
int pixels_of(double value) {
  constexpr int kMost = 1 << 15;
  return value >= 1 && value <= kMost ? static_cast<int>(value) : 0;
}

void read_size(const Json& entry, Calibration& calibration) {
  const auto width = number(find(entry, {"image_width", "width", "w", "img_width", "imageWidth"}));
  const auto height = number(find(entry, {"image_height", "height", "h", "img_height", "imageHeight"}));
  const auto both = list(find(entry, {"image_size", "imageSize", "resolution", "img_size", "img_shape", "size"}));
  if (width && height)
    calibration.width = pixels_of(*width), calibration.height = pixels_of(*height);
  else if (both && both->size() == 2)
    calibration.width = pixels_of((*both)[0]), calibration.height = pixels_of((*both)[1]);
}

const Json* camera_matrix(const Json& entry) {
  return find(entry, {"camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "intrinsics_matrix", "mtx", "M1", "M",
                      "camera_intrinsics", "intrinsic", "intrinsics"});
}

const Json* distortion_of(const Json& entry) {
  return find(entry, {"distortion_coefficients", "dist_coeffs", "distCoeffs", "dist_coeff", "distortion",
                      "distortion_coeffs", "dist", "D", "D1", "distortionCoefficients", "coeffs"});
}

// OpenCV's list of 4, 5, 8, 12 or 14 coefficients, or its four of a fisheye.
void set_distortion(const Json& entry, const Source& source, const std::string& model, Lens& lens) {
  const Json* value = distortion_of(entry);
  std::vector<double> k;
  if (!value || value->is_null()) {  // by name
    for (const char* name : {"k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"})
      k.push_back(number(find(entry, {name})).value_or(0.0));
    while (!k.empty() && k.back() == 0.0) k.pop_back();
  } else if (const auto m = matrix(*value)) {
    k.assign(m->data(), m->data() + m->size());
  } else if (!(value->is_array() && value->empty())) {
    throw wrong(source, "its distortion is no list of numbers", "write k1, k2, p1, p2, k3");
  }
  for (std::size_t i = 8; i < k.size(); ++i)
    if (k[i] != 0.0)
      throw wrong(source, "has thin prism or tilted coefficients, which are not supported",
                  "calibrate with at most eight coefficients");
  const bool fisheye = model.find("fisheye") != std::string::npos || model.find("equidistant") != std::string::npos ||
                       model.find("kannala") != std::string::npos;
  const bool plain = model.empty() || model == "none" || model.find("plumb") != std::string::npos ||
                     model.find("radtan") != std::string::npos || model.find("rational") != std::string::npos ||
                     model.find("brown") != std::string::npos || model.find("opencv") != std::string::npos ||
                     model.find("pinhole") != std::string::npos || model.find("radial") != std::string::npos ||
                     model.find("perspective") != std::string::npos;
  const bool any = std::any_of(k.begin(), k.end(), [](double value_of_k) { return value_of_k != 0.0; });
  if (!any) return;
  if (model.find("inverse") != std::string::npos)
    throw wrong(source, "its distortion model '" + model + "' is not supported", "calibrate with OpenCV's model");
  if (!fisheye && !plain)
    throw wrong(source, "its distortion model '" + model + "' is not supported",
                "calibrate with plumb_bob (radtan), rational_polynomial or equidistant (fisheye)");
  lens.model = fisheye ? LensModel::fisheye : k.size() > 5 ? LensModel::rational : LensModel::opencv;
  k.resize(std::min<std::size_t>(k.size(), 8));
  lens.coefficients = k;
}

// A camera matrix, or fx, fy, cx, cy by name, and a list of coefficients: OpenCV, ROS, and what people write by hand.
std::optional<Calibration> read_opencv(const Json& entry, const Source& source, const std::string& camera) {
  const Json* inside = find(entry, {"intrinsics", "intrinsic", "camera_intrinsics", "intrinsic_parameters"});
  if (inside && inside->is_object() && !find(*inside, {"data"})) {  // beside "extrinsics": one level less
    Json flat = *inside;
    for (const auto& item : entry.items())
      if (&item.value() != inside && !flat.contains(item.key())) flat[item.key()] = item.value();
    return read_opencv(flat, source, camera);
  }
  const Json* k = camera_matrix(entry);
  const auto m = k ? matrix(*k) : std::nullopt;
  Calibration out;
  Lens& lens = out.lens;
  if (m && m->rows() == 3 && m->cols() == 3) {
    lens = {.fx = (*m)(0, 0), .fy = (*m)(1, 1), .cx = (*m)(0, 2), .cy = (*m)(1, 2)};
  } else {
    const Json& named = k && k->is_object() ? *k : entry;
    const auto fx = number(find(named, {"fx"})), fy = number(find(named, {"fy"}));
    const auto cx = number(find(named, {"cx", "ppx"})), cy = number(find(named, {"cy", "ppy"}));
    if (!fx || !fy || !cx || !cy) return std::nullopt;
    lens = {.fx = *fx, .fy = *fy, .cx = *cx, .cy = *cy};
  }
  const Json* model = find(entry, {"distortion_model", "camera_model", "model"});
  std::string model_name = model && model->is_string() ? lower(model->get<std::string>()) : "";
  if (number(find(entry, {"fisheye_model"})).value_or(0.0) != 0.0) model_name = "fisheye";  // OpenCV's own example
  const bool ros =
      find(entry, {"rectification_matrix", "projection_matrix", "R", "P"}) && find(entry, {"distortion_model"});
  out.format = ros ? "ROS camera_info" : "OpenCV";
  out.half_pixel_added = true;
  lens.cx += 0.5, lens.cy += 0.5;
  set_distortion(entry, source, model_name, lens);
  read_size(entry, out);
  if (ros) {
    Json without = entry;  // its R rectifies, and is no pose
    for (const char* key : {"R", "P", "rectification_matrix", "projection_matrix"}) without.erase(key);
    out.pose = find_pose(without, source.file.string(), camera);
  } else {
    out.pose = find_pose(entry, source.file.string(), camera);
  }
  return out;
}

std::optional<Calibration> read_ours(const Json& entry) {
  if (!find(entry, {"world_from_camera"}) || !find(entry, {"fx"})) return std::nullopt;
  Calibration out;
  out.format = "chainsplat";
  const auto value = [&](const char* key) { return number(find(entry, {key})).value_or(0.0); };
  out.lens = {.fx = value("fx"), .fy = value("fy"), .cx = value("cx"), .cy = value("cy")};
  if (const auto k = list(find(entry, {"distortion"}))) out.lens.coefficients = *k;
  out.readout = number(find(entry, {"readout"}));
  read_size(entry, out);
  if (const auto m = matrix(*find(entry, {"world_from_camera"})))
    if (const auto pose = rigid(*m))
      out.pose = FoundPose{*pose, Direction::world_from_camera, Axes::opencv, "world_from_camera"};
  return out;
}

// Kalibr's chain: T_cn_cnm1 of each camera takes the camera before it to it, T_cam_imu the IMU to it.
std::optional<Calibration> read_kalibr(const Json& document, const Json& entry, const Source& source) {
  const auto intrinsics = list(find(entry, {"intrinsics"}));
  if (!intrinsics || !find(entry, {"camera_model"}) || !find(entry, {"distortion_model"})) return std::nullopt;
  const Json* model = find(entry, {"camera_model"});
  if (!model->is_string() || *model != "pinhole" || intrinsics->size() != 4)
    throw wrong(source, "its camera model is not pinhole", "calibrate with pinhole-radtan or pinhole-equi");
  Calibration out;
  out.format = "Kalibr camchain";
  out.half_pixel_added = true;
  const auto& k = *intrinsics;
  out.lens = {.fx = k[0], .fy = k[1], .cx = k[2] + 0.5, .cy = k[3] + 0.5};
  const Json* distortion = find(entry, {"distortion_model"});
  set_distortion(entry, source, distortion->is_string() ? lower(distortion->get<std::string>()) : "", out.lens);
  read_size(entry, out);
  out.pose = find_pose(entry, source.file.string(), source.key);
  const auto transform = [&](const Json& of, const char* name) -> std::optional<Pose> {
    const Json* value = find(of, {name});
    const auto m = value ? matrix(*value) : std::nullopt;
    return m ? rigid(*m) : std::nullopt;
  };
  // back to the first camera of the file
  Pose camera_from_first;
  for (const auto& item : document.items()) {
    const Json& here = item.value();
    if (const auto step = transform(here, "T_cn_cnm1"))
      camera_from_first = *step * camera_from_first;
    else if (&here != &document.begin().value() && !find(here, {"T_cam_imu"}))
      break;  // no chain
    if (&here != &entry) continue;
    out.rig = source.file.string();
    out.rig_from_camera = camera_from_first.inverse();
    if (!find(document.begin().value(), {"T_cam_imu"})) return out;
    break;
  }
  if (const auto imu = transform(entry, "T_cam_imu")) {
    out.rig = source.file.string() + " (IMU)";
    out.rig_from_camera = imu->inverse();
  }
  return out;
}

// As find(): keys in any case. Null where the frame has none.
Json transform_of(const Json& frame) {
  const Json* const matrix = find(frame, {"transform_matrix"});
  return matrix ? *matrix : Json();
}

// The entry of transforms.json whose file_path is meant.
const Json& nerfstudio_frame(const Json& frames, const Source& source, const std::string& camera) {
  const std::string wanted = source.key.empty() ? camera : source.key;
  std::vector<const Json*> found;
  std::vector<std::string> names;
  for (const Json& frame : frames) {
    const Json* path = find(frame, {"file_path"});
    const std::string name = path && path->is_string() ? path->get<std::string>() : "";
    names.push_back(name);
    if (name == wanted || Path(name).filename() == wanted || Path(name).stem() == wanted) return frame;
    if (name.find(wanted) != std::string::npos) found.push_back(&frame);
  }
  if (found.size() == 1 || (found.size() > 1 && std::all_of(found.begin(), found.end(), [&](const Json* f) {
                              return transform_of(*f) == transform_of(*found[0]);
                            })))
    return *found[0];
  throw wrong(
      source,
      found.empty() ? "has no frame '" + wanted + "'" : "has several frames '" + wanted + "' with different poses",
      "name one with #FILE_PATH; it has " + list_of(names));
}

std::optional<Calibration> read_nerfstudio(const Json& document, const Source& source, const std::string& camera) {
  const Json* frames = find(document, {"frames"});
  if (!frames || !frames->is_array() || frames->empty() || !find((*frames)[0], {"transform_matrix"}))
    return std::nullopt;
  const Json& frame = nerfstudio_frame(*frames, source, camera);
  const auto value = [&](const char* key) {
    const auto own = number(find(frame, {key}));
    return own ? own : number(find(document, {key}));
  };
  Calibration out;
  out.format = "nerfstudio transforms.json";
  const auto w = value("w"), h = value("h");
  if (w && h) out.width = pixels_of(*w), out.height = pixels_of(*h);
  auto fx = value("fl_x"), fy = value("fl_y");
  if (!fx && value("camera_angle_x") && w) fx = 0.5 * *w / std::tan(0.5 * *value("camera_angle_x"));
  if (!fx || !w || !h) throw wrong(source, "has no fl_x, w and h", "write the focal length and size in pixels");
  out.lens = {
      .fx = *fx, .fy = fy.value_or(*fx), .cx = value("cx").value_or(0.5 * *w), .cy = value("cy").value_or(0.5 * *h)};
  const Json* model = find(frame, {"camera_model"}) ? find(frame, {"camera_model"}) : find(document, {"camera_model"});
  const std::string name = model && model->is_string() ? model->get<std::string>() : "OPENCV";
  const auto k = [&](const char* key) { return value(key).value_or(0.0); };
  if (name == "OPENCV_FISHEYE") {
    out.lens.model = LensModel::fisheye;
    out.lens.coefficients = {k("k1"), k("k2"), k("k3"), k("k4")};
  } else if (name == "OPENCV" || name == "PINHOLE" || name == "SIMPLE_PINHOLE") {
    out.lens.coefficients = {k("k1"), k("k2"), k("p1"), k("p2"), k("k3")};
  } else {
    throw wrong(source, "its camera model '" + name + "' is not supported", "use OPENCV or OPENCV_FISHEYE");
  }
  const auto m = matrix(transform_of(frame));
  const auto pose = m ? rigid(*m) : std::nullopt;
  if (!pose) throw wrong(source, "its transform_matrix is no rigid motion", "write 4x4, camera to world");
  out.pose = FoundPose{*pose, Direction::world_from_camera, Axes::opengl, source.file.string() + ": transform_matrix"};
  // what ns-process-data turned the world by
  if (const Json* applied = find(document, {"applied_transform"}))
    if (const auto turn = matrix(*applied); turn && rigid(*turn))
      out.pose->matrix = rigid(*turn)->inverse() * out.pose->matrix;
  return out;
}

// 'x y z qx qy qz qw', the same behind a stamp, or a matrix of 3 or 4 rows as numpy.savetxt writes it.
std::optional<FoundPose> read_pose_text(const Source& source) {
  const std::string text = core::read_file(source.file);
  std::vector<double> numbers;
  std::size_t begin = 0;
  while (begin < text.size() && numbers.size() <= 16) {
    const std::size_t end = std::min(text.find('\n', begin), text.size());
    std::string line = text.substr(begin, end - begin);
    begin = end + 1;
    line.resize(std::min(line.find('#'), line.size()));
    std::replace_if(
        line.begin(), line.end(), [](char c) { return c == ',' || c == ';' || c == '[' || c == ']' || c == '\t'; },
        ' ');
    for (std::size_t at = 0; at < line.size();) {
      const std::size_t from = line.find_first_not_of(" \r", at);
      if (from == std::string::npos) break;
      at = std::min(line.find_first_of(" \r", from), line.size());
      const auto value = number_of(std::string_view(line).substr(from, at - from));
      if (!value) return std::nullopt;
      numbers.push_back(*value);
    }
  }
  const std::size_t count = numbers.size();
  const std::string where = source.file.string();
  if (count == 7 || count == 8) {
    const double* v = numbers.data() + (count - 7);
    if (const auto pose = rigid(Vector3(v[0], v[1], v[2]), Eigen::Quaterniond(v[6], v[3], v[4], v[5])))
      return FoundPose{*pose, Direction::world_from_camera, Axes::opencv, where + ": x y z qx qy qz qw"};
  }
  if (count == 12 || count == 16) {
    const MatrixX m = Eigen::Map<const Eigen::Matrix<double, Eigen::Dynamic, 4, Eigen::RowMajor>>(
        numbers.data(), static_cast<Eigen::Index>(count / 4), 4);
    if (const auto pose = rigid(m))
      return FoundPose{*pose, direction_by(source.file.stem().string(), ""), Axes::opencv, where};
  }
  return std::nullopt;
}

}  // namespace

std::string known_calibrations() {
  return "OpenCV (YAML, JSON or XML), ROS camera_info, Kalibr camchain, COLMAP (folder with cameras and images, .txt "
         "or "
         ".bin), nerfstudio transforms.json, capture.json";
}

std::optional<Pose> rigid(const Vector3& translation, const Eigen::Quaterniond& rotation) {
  if (!translation.allFinite() || !(std::abs(rotation.norm() - 1.0) < kQuaternionNormTolerance)) return std::nullopt;
  return Pose{rotation.normalized().toRotationMatrix(), translation};
}

std::optional<Pose> rigid(const MatrixX& matrix) {
  if (matrix.cols() != 4 || (matrix.rows() != 3 && matrix.rows() != 4) || !matrix.allFinite()) return std::nullopt;
  if (matrix.rows() == 4 && !matrix.row(3).isApprox(Eigen::RowVector4d(0, 0, 0, 1), 1e-6)) return std::nullopt;
  const Matrix3 rotation = matrix.topLeftCorner<3, 3>();
  if ((rotation * rotation.transpose() - Matrix3::Identity()).cwiseAbs().maxCoeff() > kRotationTolerance ||
      rotation.determinant() < 0)
    return std::nullopt;
  return Pose{math::orthonormalized(rotation), matrix.topRightCorner<3, 1>()};
}

Calibration read_calibration(const Source& source, const std::string& camera) {
  std::error_code error;
  const Path folder = std::filesystem::is_directory(source.file, error) ? source.file : source.file.parent_path();
  const std::string name = source.file.filename().string();
  const bool by_name = name == "cameras.txt" || name == "cameras.bin" || name == "images.txt" || name == "images.bin";
  if (std::filesystem::is_directory(source.file, error) || by_name) {
    for (const Path& place : {folder, folder / "sparse" / "0", folder / "sparse", folder / "0"})
      if (is_colmap(place)) return read_colmap(place, source.key, camera);
    throw wrong(source, "is a folder without a COLMAP model", "known are " + known_calibrations());
  }
  const Json document = read_document(source.file);
  if (auto out = read_nerfstudio(document, source, camera)) return *out;
  const Json& entry = part_of(document, source, camera);
  if (auto out = read_ours(entry)) return *out;
  if (auto out = read_kalibr(document, entry, source)) return *out;
  if (auto out = read_opencv(entry, source, camera)) return *out;
  // a file of several cameras, none of which is named as this one
  if (source.key.empty())
    if (const auto parts = keys_of(document);
        !parts.empty() && document.begin().value().is_object() &&
        (read_opencv(document.begin().value(), source, "") || find(document.begin().value(), {"camera_model"})))
      throw wrong(source, "has several cameras and none is called '" + camera + "'",
                  "name one with #KEY; it has " + list_of(parts));
  throw wrong(source, "is in no known format of calibrations", "known are " + known_calibrations());
}

FoundPose read_pose(const Source& source, const std::string& camera) {
  std::error_code error;
  if (!std::filesystem::is_directory(source.file, error)) {
    if (auto found = read_pose_text(source)) return *found;
    const Json document = read_document(source.file);
    if (!find(document, {"frames"})) {
      const Json& entry = part_of(document, source, camera);
      // the key itself may name the matrix
      if (auto found = find_pose(entry, source.file.string() + (source.key.empty() ? "" : "#" + source.key), camera)) {
        if (found->direction == Direction::open && matrix(entry))
          found->direction = direction_by(source.key.empty() ? camera : source.key, camera);
        return *found;
      }
      throw wrong(source, "holds no pose that is recognized",
                  "write 'x y z qx qy qz qw', a 4x4 matrix, rvec and tvec, or position and quaternion");
    }
  }
  const Calibration calibration = read_calibration(source, camera);
  if (!calibration.pose)
    throw wrong(source, "holds no pose", "name a file with the camera's pose in the world of the robot");
  return *calibration.pose;
}

}  // namespace chainsplat::importing
