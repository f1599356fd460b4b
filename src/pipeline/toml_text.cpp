#include "src/pipeline/toml_text.h"

#include <cstdio>

#include "chainsplat/core.h"

namespace chainsplat::pipeline {

namespace {

constexpr std::string_view kByteOrderMark = "\xEF\xBB\xBF";

// Appends the letter that begins at text[i], which is beyond ASCII, as TOML's escape, and returns its bytes. What is no
// UTF-8 is left as it is, for toml++ to refuse.
std::size_t append_escaped(std::string_view text, std::size_t i, std::string& out) {
  const auto byte = [&](std::size_t at) { return at < text.size() ? static_cast<unsigned char>(text[at]) : 0u; };
  const unsigned lead = byte(i);
  const std::size_t length = lead >= 0xF0 ? 4 : lead >= 0xE0 ? 3 : 2;
  unsigned code = lead & (0xFFu >> (length + 1));
  for (std::size_t k = 1; k < length; ++k) {
    if ((byte(i + k) & 0xC0u) != 0x80u) {
      out += text[i];
      return 1;
    }
    code = code << 6u | (byte(i + k) & 0x3Fu);
  }
  char escape[11] = {};
  std::snprintf(escape, sizeof escape, "\\U%08X", code);
  out += escape;
  return length;
}

}  // namespace

void check_toml_dots(std::string_view text, const std::string& name) {
  constexpr std::size_t kMostText = 1 << 20;  // bytes
  constexpr int kMostDots = 100;              // in a line
  if (text.size() > kMostText) throw InputError(name, "is larger than 1 MiB, which no list of jobs is", "shorten it");
  int line = 1, dots = 0;
  for (const char letter : text) {
    line += letter == '\n';
    dots = letter == '\n' ? 0 : dots + (letter == '.');
    if (dots > kMostDots)
      throw InputError(name + ": line " + std::to_string(line), "has more than " + std::to_string(kMostDots) + " dots",
                       "break the line");
  }
}

std::string toml_with_x(std::string text) {
  const std::size_t from = text.starts_with(kByteOrderMark) ? kByteOrderMark.size() : 0;
  for (std::size_t i = from; i < text.size(); ++i)
    if (static_cast<unsigned char>(text[i]) >= 0x80) text[i] = 'x';
  return text;
}

std::string toml_with_escapes(std::string_view text, const std::string& name) {
  std::string out;
  std::string_view closing;  // of the text or the comment that we are in; empty: in neither
  int line = 1;
  const auto keep = [&](std::size_t from, std::size_t count) { out += text.substr(from, count); };
  for (std::size_t i = text.starts_with(kByteOrderMark) ? kByteOrderMark.size() : 0; i < text.size(); ++i) {
    const std::string_view rest = text.substr(i);
    const bool letter = static_cast<unsigned char>(rest[0]) >= 0x80;
    line += rest[0] == '\n';
    if (closing.empty()) {
      if (letter)
        throw InputError(name + ": line " + std::to_string(line), "has a letter beyond ASCII outside of quotes",
                         "put what is not a number into quotes");
      std::size_t length = 1;
      for (const std::string_view opening : {"\"\"\"", "'''", "\"", "'", "#"})
        if (rest.starts_with(opening)) {
          closing = opening == "#" ? "\n" : opening;
          length = opening.size();
          break;
        }
      keep(i, length);
      i += length - 1;
    } else if (closing[0] == '"' && rest[0] == '\\') {
      keep(i, 2);
      ++i;
      line += i < text.size() && text[i] == '\n';
    } else if (rest.starts_with(closing)) {
      std::size_t length = closing.size();
      if (length == 3)  // up to two quotes of the text itself come before
        while (length < rest.size() && rest[length] == closing[0]) ++length;
      keep(i, length);
      i += length - 1;
      closing = {};
    } else if (letter && closing == "\n") {
      out += 'x';
    } else if (letter && closing[0] == '"') {
      i += append_escaped(text, i, out) - 1;
    } else {
      keep(i, 1);
      if (rest[0] == '\n' && closing.size() == 1) closing = {};  // a text that its line does not close: toml++ says so
    }
  }
  return out;
}

}  // namespace chainsplat::pipeline
