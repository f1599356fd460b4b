// src/capture/descriptor.h - an opened file, pipe or device, closed at the end.
#pragma once
#include <unistd.h>

#include <utility>

namespace chainsplat::capture {

class Descriptor {
 public:
  explicit Descriptor(int number = -1) : number_(number) {}
  Descriptor(Descriptor&& other) noexcept : number_(std::exchange(other.number_, -1)) {}
  Descriptor& operator=(Descriptor&& other) noexcept {
    std::swap(number_, other.number_);
    return *this;
  }
  ~Descriptor() {
    if (number_ > STDERR_FILENO) ::close(number_);  // the process's own streams stay open
  }
  int number() const { return number_; }  // below 0: none

 private:
  int number_;
};

}  // namespace chainsplat::capture
