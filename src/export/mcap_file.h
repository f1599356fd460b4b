// mcap_file.h - the container MCAP (mcap.dev): messages of several topics by time, in chunks with indexes, and a
// summary without which viewers show nothing.
#pragma once
#include <cstdint>
#include <fstream>
#include <string>
#include <string_view>
#include <vector>

#include "chainsplat/core.h"

namespace chainsplat::exports {

class McapFile {
 public:
  // Creates the file. This and all others throw WorkError where it cannot be written.
  explicit McapFile(const Path& file);

  // A topic of messages in Protocol Buffers. `schema`: the message's full name; `descriptor_set`: what describes it.
  std::uint16_t add_topic(const std::string& topic, const std::string& schema, const std::string& descriptor_set);
  // `time`: ns. Messages of a chunk are on the disk when the next one begins, at the latest.
  void write(std::uint16_t topic, std::uint64_t time, std::string_view message);
  // Writes the summary and closes the file. Without it the file holds what was written, but needs to be recovered.
  void finish();

 private:
  struct Topic {
    std::uint32_t messages = 0;
    std::string index;  // of the open chunk: time and offset of each message
  };
  struct Chunk {
    std::uint64_t first = 0, last = 0, at = 0, length = 0, index_length = 0, size = 0;  // ns, ns, bytes
    std::string index_at;  // topic and offset of each index
  };
  void append(std::string_view bytes);  // to the file
  void end_chunk();

  Path path_;
  std::ofstream out_;
  std::uint64_t at_ = 0;
  std::vector<std::string> schemas_;  // names; the first has the number 1
  std::vector<Topic> topics_;         // the first has the number 0
  std::string schema_records_, topic_records_;
  std::vector<Chunk> chunks_;
  std::string records_;  // of the open chunk
  Chunk open_;
};

}  // namespace chainsplat::exports
