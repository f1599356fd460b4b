// damage.h - what is wrong with an image's file, found before a library reads it and prints a line, asks for gigabytes
// or ends the program.
#pragma once
#include <string>

#include "src/capture/media.h"

namespace chainsplat::capture::media {

constexpr int kMostChannels = 8;    // enough for colors, alpha and depth; a damaged header may claim any number
constexpr int kMostSide = 1 << 16;  // pixels; OpenImageIO reads 64 rows at a time, however wide they are

// Each returns the problem, to be said of the file, or an empty text where it is sound or of another format. Of a PNG
// every chunk's checksum is compared; of an EXR the header alone is read, since OpenEXR would allocate the claimed
// length of an attribute and the claimed lines of pixels before it reads them.
std::string damage_of_png(const Path& file);
std::string damage_of_exr(const Path& file);

}  // namespace chainsplat::capture::media
