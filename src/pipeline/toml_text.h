// toml_text.h - a TOML text from outside without what toml++ 3.3 cannot be given.
//
// It frees tables in tables by recursion, and runs past the end of a table where it asks whether a letter beyond ASCII
// is white space, even after a backslash that ends a line. TOML has such letters in texts and comments only, so that a
// text is parsed twice: with every letter replaced, which finds what is no TOML, then with every letter as an escape.
#pragma once
#include <string>
#include <string_view>

namespace chainsplat::pipeline {

// Throws InputError where the text is over 1 MiB or a line has over 100 dots: a key with dots makes a table in a table
// for each, which toml++ does not bound. `name`: of the file, for what is thrown.
void check_toml_dots(std::string_view text, const std::string& name);

// The text with an x for every byte beyond ASCII.
std::string toml_with_x(std::string text);

// The text with escapes for letters beyond ASCII in texts; those within single quotes stay, since toml++ does not ask
// there. `text` must be TOML but for letters outside of quotes, which are refused with InputError.
std::string toml_with_escapes(std::string_view text, const std::string& name);

}  // namespace chainsplat::pipeline
