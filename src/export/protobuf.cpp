#include "protobuf.h"

namespace chainsplat::exports::protobuf {

namespace {

// Numbers of descriptor.proto's fields stand beside their names there.
Message described(const Field& field) {
  constexpr std::uint64_t kOptional = 1, kRepeated = 3;
  Message out;
  out.bytes(1, field.name).integer(3, static_cast<std::uint64_t>(field.number));
  out.integer(4, field.repeated ? kRepeated : kOptional).integer(5, static_cast<std::uint64_t>(field.type));
  if (*field.type_name) out.bytes(6, field.type_name);
  return out;
}

Message described(const Enumeration& enumeration) {
  Message out;
  out.bytes(1, enumeration.name);
  for (std::size_t i = 0; i < enumeration.values.size(); ++i)
    out.message(2, Message().bytes(1, enumeration.values[i]).integer(2, i));
  return out;
}

Message described(const Definition& message) {
  Message out;
  out.bytes(1, message.name);
  for (const Field& field : message.fields) out.message(2, described(field));
  for (const Enumeration& enumeration : message.enumerations) out.message(4, described(enumeration));
  return out;
}

}  // namespace

std::string descriptor_set(const std::vector<File>& files) {
  Message set;
  for (const File& file : files) {
    Message out;
    out.bytes(1, file.name).bytes(2, file.package);
    for (const char* const import : file.imports) out.bytes(3, import);
    for (const Definition& message : file.messages) out.message(4, described(message));
    set.message(1, out.bytes(12, "proto3"));
  }
  return set.text();
}

}  // namespace chainsplat::exports::protobuf
