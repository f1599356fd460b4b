#include "src/eval/onnx.h"

#include <cstdint>
#include <limits>
#include <map>
#include <optional>
#include <string_view>
#include <utility>
#include <vector>

namespace chainsplat::eval {

namespace {

constexpr std::int64_t kMostKernel = 64, kMostStride = 64;  // px; AlexNet has 11 and 4
constexpr std::int64_t kMostChannels = 1 << 16;
constexpr int kColors = 3;

// Numbers of fields, of onnx.proto.
constexpr std::uint32_t kModelGraph = 7;
constexpr std::uint32_t kGraphNode = 1, kGraphInitializer = 5, kGraphInput = 11, kGraphOutput = 12;
constexpr std::uint32_t kNodeInput = 1, kNodeOutput = 2, kNodeName = 3, kNodeOperator = 4, kNodeAttribute = 5,
                        kNodeText = 6, kNodeDomain = 7;
constexpr std::uint32_t kAttributeName = 1, kAttributeInt = 3, kAttributeInts = 8, kAttributeType = 20;
constexpr std::uint32_t kTensorDims = 1, kTensorType = 2, kTensorName = 8, kTensorRaw = 9;
constexpr std::uint32_t kValueName = 1;
constexpr std::uint32_t kFloat = 1;                   // of TensorProto.DataType
constexpr std::uint32_t kTypeInt = 2, kTypeInts = 7;  // of AttributeProto.AttributeType

struct Damaged {
  std::string why;
};

// One field of a message: a number, or bytes that are a text, a message or packed numbers.
struct Field {
  std::uint32_t number = 0;
  bool is_number = false;
  std::uint64_t value = 0;
  std::string_view bytes;
};

std::uint64_t varint(std::string_view& rest) {
  std::uint64_t value = 0;
  for (int shift = 0; shift < 64; shift += 7) {
    if (rest.empty()) throw Damaged{"it ends within a number"};
    const auto byte = static_cast<std::uint8_t>(rest.front());
    rest.remove_prefix(1);
    value |= std::uint64_t{byte & 0x7fu} << shift;
    if (byte < 0x80) return value;
  }
  throw Damaged{"a number is longer than 64 bits"};
}

std::string_view taken(std::string_view& rest, std::uint64_t size) {
  if (size > rest.size()) throw Damaged{"a part is longer than what is left of the file"};
  const std::string_view part = rest.substr(0, size);
  rest.remove_prefix(size);
  return part;
}

std::vector<Field> fields(std::string_view message) {
  std::vector<Field> out;
  while (!message.empty()) {
    const std::uint64_t key = varint(message), kind = key & 7;
    if (key >> 3 == 0 || key >> 3 > std::numeric_limits<std::uint32_t>::max()) throw Damaged{"a field has no number"};
    Field field{static_cast<std::uint32_t>(key >> 3), kind == 0, 0, {}};
    switch (kind) {
      case 0:
        field.value = varint(message);
        break;
      case 1:
        field.bytes = taken(message, 8);
        break;
      case 2:
        field.bytes = taken(message, varint(message));
        break;
      case 5:
        field.bytes = taken(message, 4);
        break;
      default:
        throw Damaged{"a field is of no known kind"};
    }
    out.push_back(field);
  }
  return out;
}

// A number of a repeated field, which stand one by one or packed.
void append(const Field& field, std::vector<std::int64_t>& numbers) {
  if (field.is_number) return numbers.push_back(static_cast<std::int64_t>(field.value));
  for (std::string_view packed = field.bytes; !packed.empty();)
    numbers.push_back(static_cast<std::int64_t>(varint(packed)));
}

std::string text(const Field& field) {
  if (field.is_number) throw Damaged{"a name is a number"};
  return std::string(field.bytes);
}

struct Tensor {
  std::string name;
  std::vector<std::int64_t> dims;
};

// Floats in raw_data, as NumPy's arrays are written, and nothing beside them.
Tensor tensor(std::string_view message) {
  Tensor out;
  std::size_t raw = 0;
  std::uint64_t type = 0;
  for (const Field& field : fields(message)) switch (field.number) {
      case kTensorDims:
        append(field, out.dims);
        break;
      case kTensorType:
        type = field.value;
        break;
      case kTensorName:
        out.name = text(field);
        break;
      case kTensorRaw:
        raw = field.bytes.size();
        break;
      default:
        throw Damaged{"weights have a part that is neither name, size nor numbers"};
    }
  if (type != kFloat) throw Damaged{"weights are no floats"};
  std::uint64_t size = sizeof(float);
  for (const std::int64_t dim : out.dims) {
    if (dim < 1 || dim > kMostChannels) throw Damaged{"weights of " + std::to_string(dim) + " rows"};
    size *= static_cast<std::uint64_t>(dim);
    if (size > raw) break;
  }
  if (size != raw) throw Damaged{"weights '" + out.name + "' are not as many as their size says"};
  return out;
}

struct Attribute {
  std::uint64_t type = 0;
  std::vector<std::int64_t> numbers;
};

struct Node {
  std::string name;  // of the operator
  std::vector<std::string> inputs, outputs;
  std::map<std::string, Attribute> attributes;
};

// With its name.
std::pair<std::string, Attribute> attribute(std::string_view message) {
  std::pair<std::string, Attribute> out;
  for (const Field& field : fields(message)) switch (field.number) {
      case kAttributeName:
        out.first = text(field);
        break;
      case kAttributeInt:
      case kAttributeInts:
        append(field, out.second.numbers);
        break;
      case kAttributeType:
        out.second.type = field.value;
        break;
      default:
        throw Damaged{"an attribute is no whole number"};
    }
  return out;
}

Node node(std::string_view message) {
  Node out;
  for (const Field& field : fields(message)) switch (field.number) {
      case kNodeInput:
        out.inputs.push_back(text(field));
        break;
      case kNodeOutput:
        out.outputs.push_back(text(field));
        break;
      case kNodeOperator:
        out.name = text(field);
        break;
      case kNodeAttribute:
        if (!out.attributes.insert(attribute(field.bytes)).second) throw Damaged{"an attribute is given twice"};
        break;
      case kNodeName:
      case kNodeText:
      case kNodeDomain:
        break;
      default:
        throw Damaged{"a node has a part that is none of a node"};
    }
  return out;
}

// What a convolution or pooling may say of itself: so many numbers, in these bounds.
struct Limits {
  std::size_t count;
  std::uint64_t type;
  std::int64_t least, most;
};
const std::map<std::string, Limits> kLimits = {
    {"kernel_shape", {2, kTypeInts, 1, kMostKernel}}, {"pads", {4, kTypeInts, 0, kMostKernel}},
    {"strides", {2, kTypeInts, 1, kMostStride}},      {"dilations", {2, kTypeInts, 1, 1}},
    {"group", {1, kTypeInt, 1, kMostChannels}},       {"ceil_mode", {1, kTypeInt, 0, 0}},
    {"storage_order", {1, kTypeInt, 0, 0}},
};

void check_attributes(const Node& node, const std::vector<std::int64_t>& kernel) {
  for (const auto& [name, given] : node.attributes) {
    const auto found = kLimits.find(name);
    if (found == kLimits.end()) throw Damaged{"'" + name + "' is nothing that a " + node.name + " of a trunk has"};
    const Limits& limits = found->second;
    if (given.type != limits.type || given.numbers.size() != limits.count)
      throw Damaged{"'" + name + "' is not " + std::to_string(limits.count) +
                    (limits.count == 1 ? " number" : " numbers")};
    for (const std::int64_t number : given.numbers)
      if (number < limits.least || number > limits.most) throw Damaged{"'" + name + "' has " + std::to_string(number)};
  }
  const auto shape = node.attributes.find("kernel_shape");
  if (shape == node.attributes.end()) throw Damaged{"a " + node.name + " has no 'kernel_shape'"};
  if (!kernel.empty() && shape->second.numbers != kernel) throw Damaged{"a kernel is of another size than its weights"};
  if (const auto pads = node.attributes.find("pads"); pads != node.attributes.end())
    for (std::size_t side = 0; side < 4; ++side)
      if (pads->second.numbers[side] >= shape->second.numbers[side % 2]) throw Damaged{"a kernel lies in its pads"};
}

// What is known while the graph is gone through: channels of pictures, sizes of weights.
struct Known {
  std::map<std::string, std::int64_t> channels;
  std::map<std::string, std::vector<std::int64_t>> weights;
};

void check_node(const Node& node, Known& known) {
  if (node.outputs.size() != 1 || node.outputs[0].empty()) throw Damaged{"a node has not one output"};
  const bool convolves = node.name == "Conv";
  if (!convolves && node.name != "Relu" && node.name != "MaxPool")
    throw Damaged{"'" + node.name + "' is none of Conv, Relu and MaxPool"};
  if (node.inputs.size() != (convolves ? 3 : 1)) throw Damaged{"a " + node.name + " has other inputs"};
  const auto from = known.channels.find(node.inputs[0]);
  if (from == known.channels.end()) throw Damaged{"'" + node.inputs[0] + "' is used before it is there"};
  std::int64_t channels = from->second;
  if (convolves) {
    const auto weights = known.weights.find(node.inputs[1]), bias = known.weights.find(node.inputs[2]);
    if (weights == known.weights.end() || bias == known.weights.end()) throw Damaged{"a Conv has no weights"};
    const std::vector<std::int64_t>& dims = weights->second;
    check_attributes(node, dims.size() == 4 ? std::vector{dims[2], dims[3]} : dims);
    const auto group = node.attributes.find("group");
    const std::int64_t groups = group == node.attributes.end() ? 1 : group->second.numbers[0];
    if (dims.size() != 4 || dims[1] * groups != channels || dims[0] % groups != 0 ||
        bias->second != std::vector{dims[0]})
      throw Damaged{"weights '" + node.inputs[1] + "' are of another size than what they weigh"};
    channels = dims[0];
  } else if (node.name == "MaxPool") {
    check_attributes(node, {});
  } else if (!node.attributes.empty()) {
    throw Damaged{"a Relu has attributes"};
  }
  if (known.weights.count(node.outputs[0]) || !known.channels.emplace(node.outputs[0], channels).second)
    throw Damaged{"'" + node.outputs[0] + "' is there twice"};
}

std::string value_name(std::string_view message) {
  for (const Field& field : fields(message))
    if (field.number == kValueName) return text(field);
  throw Damaged{"an input or output has no name"};
}

void check_graph(std::string_view message) {
  Known known;
  std::vector<Node> nodes;
  std::vector<std::string> inputs, outputs;
  for (const Field& field : fields(message)) switch (field.number) {
      case kGraphNode:
        nodes.push_back(node(field.bytes));
        break;
      case kGraphInitializer: {
        const Tensor weights = tensor(field.bytes);
        if (!known.weights.emplace(weights.name, weights.dims).second)
          throw Damaged{"weights '" + weights.name + "' are there twice"};
        break;
      }
      case kGraphInput:
        inputs.push_back(value_name(field.bytes));
        break;
      case kGraphOutput:
        outputs.push_back(value_name(field.bytes));
        break;
      default:
        break;
    }
  for (const std::string& input : inputs)
    if (!known.weights.count(input)) known.channels.emplace(input, kColors);
  if (known.channels.size() != 1) throw Damaged{"it has not one picture as its input"};
  for (const Node& one : nodes) check_node(one, known);
  for (const std::string& output : outputs)
    if (!known.channels.count(output)) throw Damaged{"nothing makes its output '" + output + "'"};
}

}  // namespace

void check_trunk(const Path& file, const std::string& bytes) {
  try {
    std::optional<std::string_view> graph;
    for (const Field& field : fields(bytes)) {
      if (field.number != kModelGraph) continue;
      if (graph || field.is_number) throw Damaged{"it has not one graph"};
      graph = field.bytes;
    }
    if (!graph) throw Damaged{"it has no graph"};
    check_graph(*graph);
  } catch (const Damaged& damage) {
    throw InputError(file.string(), "is no network that LPIPS can take (" + damage.why + ")",
                     "make it with tools/lpips_trunk");
  }
}

}  // namespace chainsplat::eval
