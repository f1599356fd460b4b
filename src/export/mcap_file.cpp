#include "mcap_file.h"

#include <zlib.h>

#include <algorithm>

#include "little_endian.h"

namespace chainsplat::exports {

namespace {

constexpr std::string_view kMagic = "\x89MCAP0\r\n";
constexpr std::size_t kChunkBytes = 1 << 20;         // of a chunk that is closed by its size
constexpr std::uint64_t kChunkTime = 1'000'000'000;  // ns; what a stream that is killed loses at most
constexpr std::string_view kStored;                  // name of the compression

// Opcodes of the records
enum Kind : unsigned char {
  kHeader = 1,
  kFooter = 2,
  kSchema = 3,
  kTopic = 4,
  kMessage = 5,
  kChunk = 6,
  kMessageIndex = 7,
  kChunkIndex = 8,
  kStatistics = 11,
  kSummaryOffset = 14,
  kDataEnd = 15
};

std::string record(Kind kind, std::string_view content) {
  std::string out(1, static_cast<char>(kind));
  put<std::uint64_t>(out, content.size());
  return out.append(content);
}

void put_text(std::string& out, std::string_view text) {
  put<std::uint32_t>(out, static_cast<std::uint32_t>(text.size()));
  out += text;
}

std::uint32_t checksum(std::string_view bytes) {
  return static_cast<std::uint32_t>(::crc32_z(0, reinterpret_cast<const unsigned char*>(bytes.data()), bytes.size()));
}

}  // namespace

McapFile::McapFile(const Path& file) : path_(file), out_(file, std::ios::binary | std::ios::trunc) {
  std::string header;
  put_text(header, "");  // profile
  put_text(header, "chainsplat " CHAINSPLAT_VERSION);
  append(kMagic);
  append(record(kHeader, header));
}

void McapFile::append(std::string_view bytes) {
  out_.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  if (!out_) throw WorkError(path_.string(), "cannot be written", "check the folder and the free space");
  at_ += bytes.size();
}

std::uint16_t McapFile::add_topic(const std::string& topic, const std::string& schema,
                                  const std::string& descriptor_set) {
  auto known = std::find(schemas_.begin(), schemas_.end(), schema);
  if (known == schemas_.end()) {
    schemas_.push_back(schema);
    known = schemas_.end() - 1;
    std::string content;
    put(content, static_cast<std::uint16_t>(schemas_.size()));
    put_text(content, schema);
    put_text(content, "protobuf");
    put_text(content, descriptor_set);
    const std::string bytes = record(kSchema, content);
    records_ += bytes;
    schema_records_ += bytes;
  }
  const auto number = static_cast<std::uint16_t>(topics_.size());
  topics_.emplace_back();
  std::string content;
  put(content, number);
  put(content, static_cast<std::uint16_t>(known - schemas_.begin() + 1));
  put_text(content, topic);
  put_text(content, "protobuf");
  put_text(content, "");  // an empty map
  const std::string bytes = record(kTopic, content);
  records_ += bytes;
  topic_records_ += bytes;
  return number;
}

void McapFile::write(std::uint16_t topic, std::uint64_t time, std::string_view message) {
  if (open_.size > 0 && (records_.size() > kChunkBytes || time > open_.first + kChunkTime)) end_chunk();
  Topic& of = topics_.at(topic);
  put(of.index, time);
  put<std::uint64_t>(of.index, records_.size());
  std::string content;
  put(content, topic);
  put(content, of.messages++);
  put(content, time);  // logged
  put(content, time);  // published
  records_ += record(kMessage, content.append(message));
  open_.first = open_.size == 0 ? time : std::min(open_.first, time);
  open_.last = std::max(open_.last, time);
  open_.size = records_.size();
}

void McapFile::end_chunk() {
  std::string content;
  put(content, open_.first);
  put(content, open_.last);
  put<std::uint64_t>(content, records_.size());
  put(content, checksum(records_));
  put_text(content, kStored);
  put<std::uint64_t>(content, records_.size());
  const std::string bytes = record(kChunk, content.append(records_));
  open_.at = at_;
  open_.length = bytes.size();
  append(bytes);
  for (std::size_t i = 0; i < topics_.size(); ++i) {
    if (topics_[i].index.empty()) continue;
    const auto number = static_cast<std::uint16_t>(i);
    put(open_.index_at, number);
    put(open_.index_at, at_);
    std::string index;
    put(index, number);
    put_text(index, topics_[i].index);
    topics_[i].index.clear();
    append(record(kMessageIndex, index));
  }
  open_.index_length = at_ - open_.at - open_.length;
  chunks_.push_back(std::move(open_));
  open_ = {};
  records_.clear();
  out_.flush();
}

void McapFile::finish() {
  if (open_.size > 0) end_chunk();
  append(record(kDataEnd, std::string(4, '\0')));  // without a checksum of all

  std::string indexes, statistics, counts;
  std::uint64_t messages = 0, first = 0, last = 0;
  for (const Chunk& chunk : chunks_) {
    std::string content;
    for (const std::uint64_t number : {chunk.first, chunk.last, chunk.at, chunk.length}) put(content, number);
    put_text(content, chunk.index_at);
    put(content, chunk.index_length);
    put_text(content, kStored);
    put(content, chunk.size);
    put(content, chunk.size);
    indexes += record(kChunkIndex, content);
    first = &chunk == chunks_.data() ? chunk.first : std::min(first, chunk.first);
    last = std::max(last, chunk.last);
  }
  for (std::size_t i = 0; i < topics_.size(); ++i) {
    put(counts, static_cast<std::uint16_t>(i));
    put<std::uint64_t>(counts, topics_[i].messages);
    messages += topics_[i].messages;
  }
  put(statistics, messages);
  put(statistics, static_cast<std::uint16_t>(schemas_.size()));
  put(statistics, static_cast<std::uint32_t>(topics_.size()));
  put<std::uint32_t>(statistics, 0);  // attachments
  put<std::uint32_t>(statistics, 0);  // metadata
  put(statistics, static_cast<std::uint32_t>(chunks_.size()));
  put(statistics, first);
  put(statistics, last);
  put_text(statistics, counts);

  const std::uint64_t summary_at = at_;
  std::string summary, offsets;
  const auto group = [&](Kind kind, const std::string& records) {
    std::string content(1, static_cast<char>(kind));
    put<std::uint64_t>(content, summary_at + summary.size());
    put<std::uint64_t>(content, records.size());
    offsets += record(kSummaryOffset, content);
    summary += records;
  };
  if (!schema_records_.empty()) group(kSchema, schema_records_);
  if (!topic_records_.empty()) group(kTopic, topic_records_);
  if (!indexes.empty()) group(kChunkIndex, indexes);
  group(kStatistics, record(kStatistics, statistics));
  const std::uint64_t offsets_at = summary_at + summary.size();
  summary += offsets;
  // the checksum is of all before it, the beginning of its own record included
  std::string footer;
  put(footer, summary_at);
  put(footer, offsets_at);
  put<std::uint32_t>(footer, 0);
  footer = record(kFooter, footer);
  footer.resize(footer.size() - sizeof(std::uint32_t));
  put(footer, checksum(summary + footer));
  append(summary + footer);
  append(kMagic);
  out_.close();
  if (!out_) throw WorkError(path_.string(), "cannot be written", "check the folder and the free space");
}

}  // namespace chainsplat::exports
