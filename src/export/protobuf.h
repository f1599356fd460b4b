// protobuf.h - what Foxglove's messages need of Protocol Buffers (proto3), and the description of messages by which a
// reader that has never heard of them decodes them (descriptor.proto).
#pragma once
#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "little_endian.h"

namespace chainsplat::exports::protobuf {

// The bytes of one message, field by field. Values of 0 are written, too.
class Message {
 public:
  Message& integer(int field, std::uint64_t value) {
    key(field, 0);
    varint(value);
    return *this;
  }
  Message& number(int field, double value) {
    key(field, 1);
    put(bytes_, value);
    return *this;
  }
  Message& bytes(int field, std::string_view value) {  // texts and messages, too
    key(field, 2);
    varint(value.size());
    bytes_ += value;
    return *this;
  }
  Message& message(int field, const Message& value) { return bytes(field, value.bytes_); }
  Message& numbers(int field, const std::vector<double>& values) {  // repeated, packed
    std::string packed;
    for (const double value : values) put(packed, value);
    return bytes(field, packed);
  }
  Message& fixed(int field, std::uint32_t value) {
    key(field, 5);
    put(bytes_, value);
    return *this;
  }
  const std::string& text() const { return bytes_; }

 private:
  void key(int field, unsigned wire_type) { varint(static_cast<unsigned>(field) << 3u | wire_type); }
  void varint(std::uint64_t value) {
    for (; value >= 0x80; value >>= 7u) bytes_ += static_cast<char>(0x80u | (value & 0x7Fu));
    bytes_ += static_cast<char>(value);
  }
  std::string bytes_;
};

// FieldDescriptorProto.Type
enum class Type {
  real = 1,
  int64 = 3,
  int32 = 5,
  fixed32 = 7,
  boolean = 8,
  text = 9,
  message = 11,
  bytes = 12,
  enumeration = 14
};

struct Field {
  int number = 0;
  const char* name = "";
  Type type = Type::message;
  const char* type_name = "";  // of a message or an enumeration: ".foxglove.Vector3"
  bool repeated = false;
};
struct Enumeration {
  const char* name;
  std::vector<const char*> values;  // 0, 1, ...
};
struct Definition {
  const char* name;
  std::vector<Field> fields;
  std::vector<Enumeration> enumerations = {};
};
struct File {
  const char* name;     // "foxglove/rope.proto"
  const char* package;  // "foxglove"
  std::vector<const char*> imports;
  std::vector<Definition> messages;
};

// A FileDescriptorSet.
std::string descriptor_set(const std::vector<File>& files);

}  // namespace chainsplat::exports::protobuf
