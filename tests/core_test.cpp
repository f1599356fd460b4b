#include "chainsplat/core.h"
#include "chainsplat/json.h"
#include "chainsplat/text.h"

#include <doctest/doctest.h>

#include <unistd.h>

#include <atomic>
#include <cmath>
#include <limits>
#include <nlohmann/json.hpp>

using namespace chainsplat;

TEST_CASE("a table's lines and numbers, and what is refused") {
  const auto lines = core::table_lines("time,a,b\r\n\n1, -2.5e3 ,\n  \n2,nan,4");
  REQUIRE(lines.size() == 3);
  CHECK(lines[0].text == "time,a,b");
  CHECK(lines[1].number == 3);
  CHECK(lines[2].number == 5);
  const auto first = core::table_numbers("t.csv", lines[1], 3, "mend", true);
  CHECK(first[1] == -2500.0);
  CHECK(std::isnan(first[2]));
  CHECK(std::isnan(core::table_numbers("t.csv", lines[2], 3, "mend", true)[1]));
  for (const int k : {1, 2}) CHECK_THROWS_AS(core::table_numbers("t.csv", lines[k], 3, "mend"), InputError);
  for (const char* wrong : {"1,2", "1,2,3,4", "1,2,x", "1,2,3x", "1,2,inf", "1 2,3,4"}) {
    CAPTURE(wrong);
    CHECK_THROWS_WITH_AS(core::table_numbers("t.csv", {7, wrong}, 3, "mend", true), doctest::Contains("t.csv:7: "),
                         InputError);
  }
}

TEST_CASE("numbers read back exactly, files as they were written") {
  for (const double value : {0.1, -1.0 / 3.0, 6.02e23, 1e-300}) CHECK(std::stod(core::exact(value)) == value);
  const Path file = std::filesystem::temp_directory_path() / ("chainsplat_core_test_" + std::to_string(::getpid()));
  core::write_file(file, std::string_view("a\0b\n", 4));
  CHECK(core::read_file(file) == std::string("a\0b\n", 4));
  std::filesystem::remove(file);
  CHECK_THROWS_AS(core::read_file(file), InputError);
  CHECK_THROWS_AS(core::write_file(file / "in" / "no" / "folder", "x"), WorkError);
}

TEST_CASE("work is divided completely, whatever the number of threads, and its exception comes back") {
  for (const int threads : {1, 2, 7}) {
    core::set_threads(threads);
    std::vector<std::atomic<int>> calls(100);
    core::parallel_for(100, [&](std::int64_t i) { ++calls[static_cast<std::size_t>(i)]; });
    for (const auto& count : calls) CHECK(count == 1);
    CHECK_THROWS_AS(core::parallel_for(10,
                                       [](std::int64_t i) {
                                         if (i == 3) throw WorkError("a", "b", "c");
                                       }),
                    WorkError);
  }
  core::set_threads(0);
}

TEST_CASE("hash and random numbers are the published ones") {
  CHECK(core::fnv1a("") == 0xcbf29ce484222325ull);
  CHECK(core::fnv1a("a") == 0xaf63dc4c8601ec8cull);
  CHECK(core::fnv1a("foobar") == 0x85944171f73967e8ull);
  core::Random random(1234567);
  for (const std::uint64_t value : {6457827717110365317ull, 3203168211198807973ull, 9817491932198370423ull})
    CHECK(random.next() == value);
}

TEST_CASE("JSON is read up to a depth, and brackets in strings do not count") {
  const auto nested = [](int depth) { return std::string(depth, '[') + std::string(depth, ']'); };
  CHECK(core::parse_json(nested(core::kDeepestJson)).is_array());
  CHECK_THROWS_AS(core::parse_json(nested(core::kDeepestJson + 1)), nlohmann::json::parse_error);
  CHECK(core::parse_json_or_discard(nested(200000)).is_discarded());
  CHECK(core::parse_json_or_discard(std::string(200000, '[')).is_discarded());
  const std::string quoted = "[\"" + std::string(500, '{') + "\\\"" + std::string(500, '[') + "\"]";
  CHECK(core::parse_json(quoted)[0].get<std::string>().size() == 1001);
}

TEST_CASE("an error's line holds no control character and no broken UTF-8, and keeps what is readable") {
  CHECK(core::printable("rope é 縄 \\") == "rope é 縄 \\");
  CHECK(core::printable(std::string_view("a\0b\nc\x1b[31m", 10)) == "a\\x00b\\x0ac\\x1b[31m");
  CHECK(core::printable("\xff\xc3 \xe2\x82 \xc2\x9b") == "\\xff\\xc3 \\xe2\\x82 \\xc2\\x9b");
  CHECK(std::string(InputError("f\n", "has\r", "mend\x7f").what()) == "f\\x0a: has\\x0d; mend\\x7f");
}

TEST_CASE("a file without end is refused instead of filling the memory") {
  CHECK_THROWS_WITH_AS(core::read_file("/dev/zero"), doctest::Contains("larger than 1 GiB"), InputError);
}

TEST_CASE("errors keep their fields") {
  const InputError error("a: b", "is; wrong", "mend\n");
  CHECK(error.where == "a: b");
  CHECK(error.problem == "is; wrong");
  CHECK(error.mend == "mend\n");
  CHECK(std::string(error.what()) == "a: b: is; wrong; mend\\x0a");
}

TEST_CASE("a listener hears what is said in its scope, and may stop the work") {
  std::vector<std::string> outer, inner;
  core::Listener before;
  before.message = [&](const std::string& line) { outer.push_back(line); };
  core::set_listener(before);
  {
    core::Listener listener;
    listener.message = [&](const std::string& line) { inner.push_back(line); };
    listener.stop = [&] { return inner.size() > 1; };
    const core::ListenerScope scope(listener);
    core::say("one");
    core::report({"stage", 1, 2, 0.0, 0.0, ""});
    core::stop_if_requested();
    core::say("two");
    core::report({"stage", 2, 2, 0.0, 0.0, ""});
    CHECK_THROWS_AS(core::stop_if_requested(), Interrupted);
  }
  core::stop_if_requested();  // the stop was the listener's
  core::say("three");
  CHECK(inner == std::vector<std::string>{"one", "two"});
  CHECK(outer == std::vector<std::string>{"three"});
  core::set_listener({});
}

TEST_CASE("numbers for people have few digits, and none too few") {
  CHECK(core::brief(1.9666666666666666) == "1.967");
  CHECK(core::brief(-5.0) == "-5");
  CHECK(core::brief(100.0) == "100");
  CHECK(core::brief(0.012345678) == "0.01235");
  CHECK(core::brief(0.0) == "0");
  CHECK(core::brief(1763800000.25) == "1763800000.25");
  CHECK(core::with_error(0.00047591, 4.83e-5) == "0.000476 +- 0.000048");
  CHECK(core::with_error(1.14196, 0.000462) == "1.14196 +- 0.00046");
  CHECK(core::with_error(-1234.4, 27.3) == "-1234 +- 27");
  CHECK(core::with_error(1e300, 1.0).size() > 300);
  CHECK(core::with_error(0.5, std::numeric_limits<double>::quiet_NaN()) == "0.5 +- nan");
  CHECK(core::with_error(0.5, 0.0) == "0.5 +- 0");
}
