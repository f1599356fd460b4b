// xml_text.h - pieces of XML for the robot formats; every number with all its digits.
#pragma once
#include <string>

#include "chainsplat/core.h"

namespace chainsplat::exports {

// Numbers with a blank between them.
template <class Values>
std::string list(const Values& values) {
  std::string out;
  for (const double value : values) out.append(out.empty() ? "" : " ").append(core::exact(value + 0.0));
  return out;
}

inline std::string attribute(const char* name, const std::string& value) {
  return std::string(" ") + name + "=\"" + value + "\"";
}

template <class Values>
std::string attribute(const char* name, const Values& values) {
  return attribute(name, list(values));
}

inline std::string attribute(const char* name, double value) { return attribute(name, core::exact(value)); }

// A name as an XML attribute or in a comment.
inline std::string escaped(const std::string& text) {
  std::string out;
  for (const char letter : core::printable(text)) switch (letter) {
      case '&':
        out += "&amp;";
        break;
      case '<':
        out += "&lt;";
        break;
      case '>':
        out += "&gt;";
        break;
      case '"':
        out += "&quot;";
        break;
      case '-':
        out += out.ends_with('-') ? " -" : "-";
        break;  // two in a row would end a comment
      default:
        out += letter;
    }
  return out;
}

}  // namespace chainsplat::exports
