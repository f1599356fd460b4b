// said.h - what the listener was told by work whose result is kept, so that it is told again where the result is used.
#pragma once
#include <string>
#include <vector>

namespace chainsplat::core {

struct Said {
  enum class Kind { warning, message, detail, record };
  Kind kind = Kind::warning;
  std::string text;
};

// Also keeps in `into`, for as long as it lives, what any thread tells the listener. One at a time in a process; of
// others that begin meanwhile nothing is kept.
class SaidScope {
 public:
  explicit SaidScope(std::vector<Said>& into);
  ~SaidScope();
  SaidScope(const SaidScope&) = delete;
  SaidScope& operator=(const SaidScope&) = delete;

 private:
  bool keeps_;
};

// Tells the listener.
void say_again(const std::vector<Said>& said);

}  // namespace chainsplat::core
