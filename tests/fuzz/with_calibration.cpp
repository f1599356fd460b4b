// The calibration board's file, as calibrate and the page that prints it read it.
#include "calibration/tags.h"
#include "chainsplat/calibration.h"
#include "readers.h"

namespace chainsplat::fuzz {

void board(std::string_view bytes) {
  const Path file = folder() / "board.json";
  put(file, bytes);
  const calibration::Board read = calibration::read_board(file);
  require(read.tags() > 0 && read.tags() <= calibration::tags_in_family(), "a board has tags of its family");
  put(file, calibration::write_board(read));
  const calibration::Board again = calibration::read_board(file);
  require(again.columns == read.columns && again.rows == read.rows && again.first_id == read.first_id &&
              again.tag_size == read.tag_size && again.spacing == read.spacing,
          "a board is the same after writing and reading");
}

}  // namespace chainsplat::fuzz
