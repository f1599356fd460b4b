// src/importing/document.h - YAML, JSON and OpenCV's XML files of other programs as one kind of tree, and the numbers in it.
#pragma once
#include <initializer_list>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "chainsplat/core.h"
#include "chainsplat/math.h"

namespace chainsplat::importing {

using Json = nlohmann::ordered_json;

// Reads YAML (OpenCV's dialect too), JSON or OpenCV's XML. Throws InputError for a file that is none of them.
Json read_document(const Path& file);

// The whole text as one finite number, spaces about it and a leading '+' allowed.
std::optional<double> number_of(std::string_view text);
std::string lower(std::string_view text);
// The words of a name: "T_world_cam0" is t, world, cam0; "camToWorld" is cam, to, world.
std::vector<std::string> words(std::string_view name);
// "a, b, c", for messages; at most 12 of them.
std::string list_of(const std::vector<std::string>& names);

// The first key of the object that is one of `names`, whatever its case, with its value; nullptr where there is none.
const Json* find(const Json& object, std::initializer_list<const char*> names);
// The value of a dotted path like "cameras.cam0"; nullptr where there is none.
const Json* find_path(const Json& document, const std::string& path);
std::optional<double> number(const Json* value);
// Numbers as a matrix: OpenCV's and ROS's {rows, cols, data}, a list of lists, or a flat list as one column; of a list
// of 9, 12 or 16 numbers 3x3, 3x4 or 4x4 row by row. None where it is none of these, or a number is not finite.
std::optional<math::MatrixX> matrix(const Json& value);
// A list of numbers, however it is nested.
std::optional<std::vector<double>> list(const Json* value);

}  // namespace chainsplat::importing
