// Fuzzes recognition's checkpoint behind its checksum, which otherwise would reject every change.
#include "readers.h"
#include "src/recognition/checkpoint.cpp"

namespace chainsplat::fuzz {

void checkpoint(std::string_view bytes) {
  static const Path here = [] {
    std::filesystem::create_directories(folder() / "checkpoint");
    return folder() / "checkpoint";
  }();
  static const Path file = here / "recognize.bin";
  recognition::Writer sum;
  sum.put(core::fnv1a(bytes));
  const std::string whole = recognition::kMagic + sum.own.front() + std::string(bytes);
  put(file, bytes.starts_with("raw") ? bytes.substr(3) : std::string_view(whole));
  std::error_code ignored;
  std::filesystem::remove(here / "recognize.before.bin", ignored);
  const auto read = recognition::parse(core::read_file(file));
  if (!read) {
    require(!recognition::load_checkpoint(here, "job"), "a damaged checkpoint is passed over");
    return;
  }
  recognition::save_checkpoint(*read, here);
  const std::string once = core::read_file(file);
  const auto again = recognition::load_checkpoint(here, read->job);
  require(again.has_value(), "what was saved is whole");
  recognition::save_checkpoint(*again, here);
  require(core::read_file(file) == once, "the same checkpoint comes back");
}

}  // namespace chainsplat::fuzz
