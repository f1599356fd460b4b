// Tests of chainsplat/gpu.h. Devices are opened with validation, and most lists run twice: with all that the device
// offers, and as on the least capable one (staged transfers). The host computes the expected values.
#include "chainsplat/gpu.h"

#include <doctest/doctest.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <numeric>

#include "gpu/device.h"

using namespace chainsplat;
using gpu::Bindings;
using gpu::Buffer;
using gpu::Commands;
using gpu::Domain;
using gpu::Pipeline;

namespace {

struct SaxpyPush {
  std::uint32_t count;
  float scale;
};

// A device with validation. Without the layer the test must fail, not pass unchecked.
gpu::DevicePtr open_validated(bool least = false) {
  gpu::DeviceOptions options;
  options.validation = true;
  options.least = least;
  return gpu::open_device(options);
}

void check_silent(const gpu::Device& device) {
  const std::vector<std::string> texts = gpu::validation_texts(device);
  CHECK(gpu::validation_messages(device) == static_cast<int>(texts.size()));
  CHECK_MESSAGE(texts.empty(), (texts.empty() ? std::string() : texts.front()));
}

std::vector<std::uint32_t> read(gpu::Device& device, const Buffer& buffer) {
  std::vector<std::uint32_t> values(buffer.bytes() / sizeof(std::uint32_t));
  gpu::download(device, buffer, values.data(), buffer.bytes());
  return values;
}

// Sets an environment variable for the lifetime of the object; null unsets it.
class Environment {
 public:
  Environment(const char* name, const char* value) : name_(name) {
    if (const char* old = std::getenv(name)) {
      old_ = old;
      had_ = true;
    }
    value ? setenv(name, value, 1) : unsetenv(name);
  }
  ~Environment() { had_ ? setenv(name_, old_.c_str(), 1) : unsetenv(name_); }

 private:
  const char* name_;
  std::string old_;
  bool had_ = false;
};

// Exit code of `body` in a child process, because drivers and the loader read some variables only once per process.
template <class Body>
int in_child(Body body) {
  const pid_t child = fork();
  if (child == 0) {
    int code = 99;
    try {
      code = body();
    } catch (...) {
    }
    _exit(code);
  }
  int status = 0;
  waitpid(child, &status, 0);
  return WIFEXITED(status) ? WEXITSTATUS(status) : -1;
}

}  // namespace

// First in the file: the children must start before this process has opened a device.
TEST_CASE("without a driver nothing throws but opening a device, and doctor says why") {
  const int code = in_child([] {
    setenv("VK_DRIVER_FILES", "/nonexistent/none.json", 1);
    setenv("VK_ICD_FILENAMES", "/nonexistent/none.json", 1);
    std::string why;
    if (!gpu::list_devices(&why).empty() || why.empty()) return 1;
    const gpu::Doctor doctor = gpu::examine();
    if (doctor.chosen != -1 || doctor.reason.find("driver") == std::string::npos) return 2;
    if (gpu::doctor_text(doctor).find("none") == std::string::npos) return 3;
    try {
      gpu::choose_device("");
      return 4;
    } catch (const InputError&) {
    }
    try {
      gpu::open_device();
      return 5;
    } catch (const InputError&) {
    }
    return 0;
  });
  CHECK(code == 0);
}

TEST_CASE("prefix sums do not depend on the subgroup size") {
  // lavapipe's vector width in bits is 32 times its subgroup size; other drivers ignore it; 512 needs AVX-512
  for (const char* width : {"128", "256", "512"}) {
    CAPTURE(width);
    const int code = in_child([width] {
      setenv("LP_NATIVE_VECTOR_WIDTH", width, 1);
      gpu::DevicePtr device = open_validated();
      constexpr std::uint32_t kCount = 1000;  // not a multiple of any work group's size
      Buffer values(*device, kCount * 4, Domain::host, "values"), prefix(*device, kCount * 4, Domain::host, "prefix"),
          size(*device, 4, Domain::host, "size");
      std::vector<std::uint32_t> expected(kCount);
      for (std::uint32_t i = 0; i < kCount; ++i) values.as<std::uint32_t>()[i] = i * i % 37;
      std::partial_sum(values.as<std::uint32_t>().begin(), values.as<std::uint32_t>().end(), expected.begin());
      for (std::uint32_t lanes : {64u, 128u, 256u}) {
        Pipeline pipeline(*device, "test_prefix", {{"values", &values}, {"prefix", &prefix}, {"size", &size}}, 4,
                          {lanes});
        Commands commands(*device);
        commands.begin();
        commands.dispatch(pipeline, &kCount, 4, 1);
        commands.submit();
        commands.wait();
        if (!std::equal(expected.begin(), expected.end(), prefix.as<std::uint32_t>().begin())) return 1;
        if (size.as<std::uint32_t>()[0] < gpu::info(*device).subgroup_size) return 2;
        if (gpu::info(*device).software &&
            gpu::info(*device).name.find(std::string(width) + " bits") != std::string::npos &&
            size.as<std::uint32_t>()[0] != static_cast<std::uint32_t>(std::atoi(width)) / 32u) {
          return 3;
        }
      }
      return gpu::validation_messages(*device) == 0 ? 0 : 4;
    });
    CHECK(code == 0);
  }
}

TEST_CASE("devices are listed and chosen by number, name and variable") {
  const std::vector<gpu::DeviceInfo> devices = gpu::list_devices();
  REQUIRE(!devices.empty());
  for (const gpu::DeviceInfo& d : devices) {
    CHECK(!d.name.empty());
    if (!d.refused.empty()) continue;
    CHECK(d.subgroup_size > 0);
    CHECK((d.subgroup_size & (d.subgroup_size - 1)) == 0);
    CHECK(d.max_storage_range >= (1u << 27));
    CHECK(d.heap_bytes > 0);
    CHECK(!d.driver.empty());
  }
  Environment none("CHAINSPLAT_DEVICE", nullptr);
  const gpu::DeviceInfo chosen = gpu::choose_device("");
  CHECK(gpu::choose_device(std::to_string(chosen.index)).name == chosen.name);
  std::string shouted = chosen.name.substr(0, 5);
  std::transform(shouted.begin(), shouted.end(), shouted.begin(), [](unsigned char c) { return std::toupper(c); });
  CHECK(gpu::choose_device(shouted).name == chosen.name);
  CHECK_THROWS_AS(gpu::choose_device("99"), InputError);
  CHECK_THROWS_AS(gpu::choose_device("-1"), InputError);
  try {
    gpu::choose_device("no such device");
    FAIL("an unknown name was taken");
  } catch (const InputError& error) {
    const std::string text = error.what();
    CHECK(text.find("no such device") != std::string::npos);
    CHECK(text.find(chosen.name) != std::string::npos);  // the message lists the available devices
    CHECK(text.find('\n') == std::string::npos);
  }
  {
    Environment wrong("CHAINSPLAT_DEVICE", "no such device");
    CHECK_THROWS_AS(gpu::choose_device(""), InputError);
    CHECK(gpu::choose_device("0").index == 0);  // the option wins over the variable
  }
  const gpu::Doctor doctor = gpu::examine();
  REQUIRE(doctor.chosen == chosen.index);
  CHECK(gpu::doctor_text(doctor).find(chosen.name) != std::string::npos);
  CHECK(gpu::examine("no such device").chosen == -1);
}

TEST_CASE("the choice prefers discrete to integrated to CPU, and never one that is refused") {
  Environment none("CHAINSPLAT_DEVICE", nullptr);
  std::vector<gpu::DeviceInfo> devices(5);
  const char* const types[] = {"CPU", "integrated GPU", "discrete GPU", "discrete GPU", "discrete GPU"};
  const char* const names[] = {"llvmpipe", "Inside 700", "Old 1080", "Card 4090", "Card 5090"};
  for (int i = 0; i < 5; ++i) {
    devices[static_cast<std::size_t>(i)].index = i;
    devices[static_cast<std::size_t>(i)].type = types[i];
    devices[static_cast<std::size_t>(i)].name = names[i];
  }
  devices[2].refused = {"has Vulkan 1.1, 1.3 is needed"};
  const auto choice = [&](const std::string& selector) { return gpu::choose(devices, selector, "", nullptr); };
  CHECK(choice("") == 3);
  CHECK(choice("1") == 1);
  CHECK(choice("4090") == 3);
  CHECK(choice("card") == 3);
  CHECK(choice("LLVM") == 0);
  CHECK(choice("0") == 0);  // an index wins over a name
  try {
    choice("old");
    FAIL("an unusable device was taken");
  } catch (const InputError& error) {
    CHECK(std::string(error.what()).find("has Vulkan 1.1") != std::string::npos);
  }
  devices[3].refused = devices[4].refused = {"lacks maintenance4"};
  CHECK(choice("") == 1);
  devices[1].refused = {"lacks maintenance4"};
  CHECK(choice("") == 0);
  devices[0].refused = {"lacks maintenance4"};
  CHECK_THROWS_AS(choice(""), InputError);
}

TEST_CASE("subgroups are of one size, within the device's range and as groups need them") {
  VkPhysicalDeviceVulkan13Properties v13{};
  v13.requiredSubgroupSizeStages = VK_SHADER_STAGE_COMPUTE_BIT;
  v13.maxComputeWorkgroupSubgroups = 16;
  struct Case {
    const char* device;
    std::uint32_t least, most, usual, wanted;
  };
  for (const Case& c : {Case{"AMD", 32, 64, 64, 32}, Case{"Intel", 8, 32, 32, 32}, Case{"wide", 64, 128, 64, 64},
                        Case{"narrow", 8, 16, 8, 16}}) {
    CAPTURE(c.device);
    v13.minSubgroupSize = c.least;
    v13.maxSubgroupSize = c.most;
    const gpu::SubgroupChoice fixed = gpu::choose_subgroups(v13, c.usual, true);
    CHECK(fixed.fixed);
    CHECK(fixed.size == c.wanted);
    CHECK(fixed.whole == c.wanted);
    // a device that cannot fix a size may use any in its range
    const gpu::SubgroupChoice any = gpu::choose_subgroups(v13, c.usual, false);
    CHECK(!any.fixed);
    CHECK(any.size == c.least);
    CHECK(any.whole == c.most);
  }
  v13.minSubgroupSize = v13.maxSubgroupSize = 32;
  const gpu::SubgroupChoice only = gpu::choose_subgroups(v13, 32, true);
  CHECK(!only.fixed);
  CHECK(only.size == 32);
  CHECK(only.whole == 32);
  // a work group of 256 lanes must fit into the number of subgroups that it may have
  v13.minSubgroupSize = 16;
  v13.maxSubgroupSize = 64;
  v13.maxComputeWorkgroupSubgroups = 4;
  CHECK(!gpu::choose_subgroups(v13, 64, true).fixed);
}

TEST_CASE("failures of the driver are work errors, a lost device by its name") {
  gpu::Device device;
  device.info.name = "some card";
  device.check(VK_SUCCESS, "work");
  for (VkResult result : {VK_ERROR_DEVICE_LOST, VK_ERROR_OUT_OF_DEVICE_MEMORY, VK_ERROR_UNKNOWN}) {
    try {
      device.check(result, "finish work");
      FAIL("a failure was taken for success");
    } catch (const WorkError& error) {
      const std::string text = error.what();
      CHECK(text.find("some card") != std::string::npos);
      CHECK(text.find("finish work") != std::string::npos);
      CHECK((text.find("lost") != std::string::npos) == (result == VK_ERROR_DEVICE_LOST));
    }
  }
}

TEST_CASE("saxpy, resubmitted and recorded again, with mapped and staged memory and both domains") {
  for (bool least : {false, true}) {
    gpu::DevicePtr device = open_validated(least);
    constexpr std::uint32_t kCount = 70001;
    const SaxpyPush push{kCount, 0.5f};
    for (Domain domain : {Domain::device, Domain::host}) {
      Buffer x(*device, kCount * 4, domain, "x"), y(*device, kCount * 4, domain, "y");
      std::vector<float> a(kCount), b(kCount), result(kCount);
      for (std::uint32_t i = 0; i < kCount; ++i) a[i] = static_cast<float>(i % 1024), b[i] = static_cast<float>(i % 7);
      gpu::upload(*device, x, a.data(), kCount * 4);
      gpu::upload(*device, y, b.data(), kCount * 4);
      const Bindings buffers{{"x", &x}, {"y", &y}};
      Commands commands(*device);
      for (std::uint32_t lanes : {32u, 64u, 256u}) {  // the work group size is a specialization constant
        gpu::upload(*device, y, b.data(), kCount * 4);
        Pipeline pipeline(*device, "test_saxpy", buffers, sizeof push, {lanes});
        commands.begin();
        commands.dispatch(pipeline, &push, sizeof push, 50, ((kCount + lanes - 1) / lanes + 49) / 50);
        commands.submit();
        commands.submit();  // the same list again, without a wait between
        commands.wait();
        gpu::download(*device, y, result.data(), kCount * 4);
        std::size_t wrong = 0;
        // halves of small integers are exact in float
        for (std::uint32_t i = 0; i < kCount; ++i) wrong += result[i] != a[i] + b[i];
        CHECK(wrong == 0);
        commands.begin();  // drops the references to the pipeline before it is destroyed
      }
    }
    check_silent(*device);
  }
}

TEST_CASE("a chain of dispatches, fills and copies runs in order") {
  for (bool least : {false, true}) {
    gpu::DevicePtr device = open_validated(least);
    constexpr std::uint32_t kCount = 4096, kLanes = 64;
    Buffer a(*device, kCount * 4, Domain::device, "a"), b(*device, kCount * 4, Domain::device, "b"),
        c(*device, kCount * 4, Domain::host, "c");
    Pipeline forth(*device, "test_add", {{"from", &a}, {"to", &b}}, 0, {kLanes, 3});
    Pipeline back(*device, "test_add", {{"from", &b}, {"to", &a}}, 0, {kLanes, 3});
    Commands commands(*device);
    constexpr int kTurns = 100;
    for (std::uint32_t recording = 0; recording < 3; ++recording) {
      commands.begin();
      commands.fill(a, 7 + recording, 0, a.bytes());
      commands.no_barrier();
      commands.fill(c, 1, 0, c.bytes());
      for (int i = 0; i < kTurns; ++i) {
        commands.dispatch(forth, nullptr, 0, kCount / kLanes);
        commands.dispatch(back, nullptr, 0, kCount / kLanes);
      }
      commands.dispatch(forth, nullptr, 0, 0);  // no groups: does nothing, and the order is kept
      commands.no_barrier();
      commands.copy(a, 4, c, 8, 4 * 100);
      commands.submit();
      commands.wait();
      const std::vector<std::uint32_t> values = read(*device, c);
      CHECK(values[0] == 1);
      CHECK(values[1] == 1);
      CHECK(values[2] == 7 + recording + 3 * 2 * kTurns);
      CHECK(values[101] == 7 + recording + 3 * 2 * kTurns);
      CHECK(values[102] == 1);
    }
    check_silent(*device);
  }
}

TEST_CASE("a recording binds the buffers of its time, also those that have taken the place of others") {
  gpu::DevicePtr device = open_validated();
  constexpr std::uint32_t kCount = 64, kLanes = 64;
  Buffer from(*device, kCount * 4, Domain::device, "from"), to;
  Pipeline pipeline(*device, "test_add", {{"from", &from}, {"to", &to}}, 0, {kLanes, 3});
  Commands commands(*device);
  int wrong = 0;
  for (std::uint32_t turn = 0; turn < 1100; ++turn) {  // more than twice as many as descriptor sets are kept
    to = Buffer();
    to = Buffer(*device, kCount * 4, Domain::device, "to");  // often with the handle of the one before
    commands.begin();
    commands.fill(from, turn, 0, from.bytes());
    commands.dispatch(pipeline, nullptr, 0, kCount / kLanes);
    commands.submit();
    commands.wait();
    wrong += read(*device, to)[kCount - 1] != turn + 3;
  }
  CHECK(wrong == 0);
  check_silent(*device);
}

TEST_CASE("an indirect dispatch takes its group counts from the device") {
  gpu::DevicePtr device = open_validated();
  constexpr std::uint32_t kLanes = 64, kRoom = 1000;
  Buffer arguments(*device, 6 * 4, Domain::device, "arguments"), from(*device, kRoom * 4, Domain::host, "from"),
      to(*device, kRoom * 4, Domain::host, "to");
  Pipeline write(*device, "test_arguments", {{"arguments", &arguments}}, 4, {kLanes});
  Pipeline add(*device, "test_add", {{"from", &from}, {"to", &to}}, 0, {kLanes, 1});
  Commands commands(*device);
  for (std::uint32_t count : {0u, 1u, 64u, 65u, kRoom}) {
    CAPTURE(count);
    std::iota(from.as<std::uint32_t>().begin(), from.as<std::uint32_t>().end(), 0u);
    std::fill(to.as<std::uint32_t>().begin(), to.as<std::uint32_t>().end(), 0u);
    commands.begin();
    commands.dispatch(write, &count, 4, 1);
    commands.dispatch_indirect(add, nullptr, 0, arguments, 3 * 4);
    commands.submit();
    commands.wait();
    const std::uint32_t reached = std::min((count + kLanes - 1) / kLanes * kLanes, kRoom);
    std::size_t wrong = 0;
    for (std::uint32_t i = 0; i < kRoom; ++i) wrong += to.as<std::uint32_t>()[i] != (i < reached ? i + 1 : 0);
    CHECK(wrong == 0);
  }
  check_silent(*device);
}

TEST_CASE("sixteen buffers and 128 bytes of push constants") {
  for (bool least : {false, true}) {
    gpu::DevicePtr device = open_validated(least);
    std::vector<Buffer> buffers;
    std::array<std::uint32_t, 32> words;
    std::uint32_t expected = 0;
    for (std::uint32_t i = 0; i < 16; ++i) {
      buffers.emplace_back(*device, 4, Domain::host, "one word");
      buffers.back().as<std::uint32_t>()[0] = 1000 + i * i;
      if (i > 0) expected += i * (1000 + i * i);
    }
    for (std::uint32_t i = 0; i < 32; ++i) words[i] = 7 * i + 5, expected += (i + 1) * words[i];
    const Bindings bindings{
        {"result", &buffers[0]}, {"b1", &buffers[1]},   {"b2", &buffers[2]},   {"b3", &buffers[3]},
        {"b4", &buffers[4]},     {"b5", &buffers[5]},   {"b6", &buffers[6]},   {"b7", &buffers[7]},
        {"b8", &buffers[8]},     {"b9", &buffers[9]},   {"b10", &buffers[10]}, {"b11", &buffers[11]},
        {"b12", &buffers[12]},   {"b13", &buffers[13]}, {"b14", &buffers[14]}, {"b15", &buffers[15]}};
    Pipeline pipeline(*device, "test_limits", bindings, sizeof words, {});
    Commands commands(*device);
    commands.begin();
    commands.dispatch(pipeline, words.data(), sizeof words, 1);
    commands.submit();
    commands.wait();
    CHECK(buffers[0].as<std::uint32_t>()[0] == expected);
    check_silent(*device);
  }
}

TEST_CASE("timings are summed by label and shorter than the wall clock") {
  gpu::DevicePtr device = open_validated();
  constexpr std::uint32_t kLanes = 64;
  // submission is to be short beside it, for which a CPU needs less work
  const std::uint32_t count = gpu::info(*device).software ? 1 << 18 : 1 << 20;
  Buffer x(*device, count * 4, Domain::device, "x"), y(*device, count * 4, Domain::device, "y");
  Pipeline saxpy(*device, "test_saxpy", {{"x", &x}, {"y", &y}}, sizeof(SaxpyPush), {kLanes});
  const SaxpyPush push{count, 2.0f};
  Commands commands(*device);
  CHECK(commands.timings().empty());
  commands.begin();
  commands.fill(x, 0, 0, x.bytes());
  commands.fill(y, 0, 0, y.bytes());
  commands.stamp("clear");
  for (int i = 0; i < 100; ++i) {  // more stamps than one query pool holds
    commands.dispatch(saxpy, &push, sizeof push, count / kLanes);
    commands.stamp(i % 2 ? "odd" : "even");
  }
  double best_share = 0.0;
  for (int turn = 0; turn < 3; ++turn) {
    const double start = core::seconds_now();
    commands.submit();
    commands.wait();
    const double wall = 1e3 * (core::seconds_now() - start);
    const std::vector<gpu::Timing> timings = commands.timings();
    if (!gpu::info(*device).timestamps) {
      CHECK(timings.empty());
      return;
    }
    REQUIRE(timings.size() == 3);
    CHECK(timings[0].label == "clear");
    CHECK(timings[1].label == "even");
    CHECK(timings[2].label == "odd");
    double sum = 0.0;
    for (const gpu::Timing& t : timings) {
      CHECK(t.milliseconds > 0.0);
      sum += t.milliseconds;
    }
    CHECK(sum <= wall);
    best_share = std::max(best_share, sum / wall);
  }
  CHECK(best_share >= 0.5);  // the remainder is submission; a wrong tick length would be noticed
  check_silent(*device);
}

TEST_CASE("buffers: transfers at offsets, in parts, of nothing, and moves") {
  for (bool least : {false, true}) {
    gpu::DevicePtr device = open_validated(least);
    constexpr std::size_t kBytes = (16u << 20) + 40;  // more than one part of staging
    std::vector<std::uint32_t> out(kBytes / 4), in(kBytes / 4);
    core::Random random(1);
    for (std::uint32_t& v : out) v = static_cast<std::uint32_t>(random.next());
    Buffer buffer(*device, kBytes + 8, Domain::device, "large");
    gpu::upload(*device, buffer, out.data(), kBytes, 8);
    gpu::download(*device, buffer, in.data(), kBytes, 8);
    CHECK(in == out);
    CHECK((buffer.mapped() != nullptr) == gpu::info(*device).unified_memory);
    Buffer moved = std::move(buffer);
    CHECK(buffer.bytes() == 0);
    CHECK(buffer.mapped() == nullptr);
    buffer = std::move(moved);
    CHECK(buffer.bytes() == kBytes + 8);
    Buffer empty(*device, 0, Domain::device, "empty");
    CHECK(empty.bytes() == 0);
    gpu::upload(*device, empty, nullptr, 0);
    CHECK(Buffer(*device, 4, Domain::host, "host").mapped() != nullptr);
    try {
      Buffer(*device, gpu::info(*device).max_storage_range + 1, Domain::device, "giant");
      FAIL("a buffer larger than the largest");
    } catch (const WorkError& error) {
      CHECK(std::string(error.what()).find("'giant'") != std::string::npos);
    }
    check_silent(*device);
  }
}

TEST_CASE("broken promises are caught before the driver sees them") {
  gpu::DevicePtr device = open_validated();
  Buffer a(*device, 64, Domain::device, "a"), b(*device, 64, Domain::device, "b");
  const Buffer empty;
  Pipeline add(*device, "test_add", {{"from", &a}, {"to", &b}}, 0, {64, 1});
  Pipeline not_made(*device, "test_add", {{"from", &a}, {"to", &empty}}, 0, {64, 1});
  Pipeline none_yet(*device, "test_add", {{"from", &a}, {"to", nullptr}}, 0, {64, 1});
  const std::uint32_t word = 0;
  Commands commands(*device);
  CHECK_THROWS_AS(commands.dispatch(add, nullptr, 0, 1), std::logic_error);  // not begun
  CHECK_THROWS_AS(commands.submit(), std::logic_error);
  commands.begin();
  CHECK_THROWS_AS(commands.dispatch(add, nullptr, 0, 65536), std::logic_error);
  CHECK_THROWS_AS(commands.dispatch(none_yet, nullptr, 0, 1), std::logic_error);
  CHECK_THROWS_AS(commands.dispatch(not_made, nullptr, 0, 1), std::logic_error);
  CHECK_THROWS_AS(commands.dispatch(add, &word, 4, 1), std::logic_error);
  CHECK_THROWS_AS(commands.dispatch_indirect(add, nullptr, 0, a, 56), std::logic_error);
  CHECK_THROWS_AS(commands.fill(a, 0, 0, 68), std::logic_error);
  CHECK_THROWS_AS(commands.fill(a, 0, 2, 4), std::logic_error);
  CHECK_THROWS_AS(commands.copy(a, 32, b, 0, 64), std::logic_error);
  CHECK_THROWS_AS(gpu::upload(*device, a, &word, 4, 61), std::logic_error);
  CHECK_THROWS_AS(Pipeline(*device, "test_add", {{"from", &a}, {"to", &b}}, 132, {}), std::logic_error);
  CHECK_THROWS_AS(Pipeline(*device, "no_such_shader", {}, 0, {}), std::logic_error);
  check_silent(*device);
}

TEST_CASE("buffers are bound by name, and a wrong name is refused with its shader's") {
  gpu::DevicePtr device = open_validated();
  Buffer a(*device, 256, Domain::host, "a"), b(*device, 256, Domain::host, "b"), c(*device, 256, Domain::host, "c");
  const auto message = [](auto body) -> std::string {
    try {
      body();
    } catch (const std::logic_error& error) {
      return error.what();
    }
    return "";
  };
  // a name that the shader declares and nobody has bound
  const std::string missing = message([&] { Pipeline(*device, "test_add", {{"from", &a}, {"too", &b}}, 0, {64, 1}); });
  CHECK(missing.find("'test_add'") != std::string::npos);
  CHECK(missing.find("'to'") != std::string::npos);
  // a name that no shader has
  Bindings bindings{{"from", &a}, {"to", &b}, {"of another shader", &c}};
  CHECK(message([&] { bindings.set("form", c); }).find("'form'") != std::string::npos);
  // a buffer that does not exist yet when it is used
  Pipeline add(*device, "test_add", bindings, 0, {64, 7});
  const Buffer empty;
  bindings.set("to", empty);
  Commands commands(*device);
  commands.begin();
  const std::string unmade = message([&] { commands.dispatch(add, nullptr, 0, 1); });
  CHECK(unmade.find("'test_add'") != std::string::npos);
  CHECK(unmade.find("'to'") != std::string::npos);
  // the order of the names means nothing, and a name can stand for another buffer in each dispatch
  bindings.set("to", b);
  std::fill(a.as<std::uint32_t>().begin(), a.as<std::uint32_t>().end(), 5u);
  commands.begin();
  commands.dispatch(add, nullptr, 0, 1);
  bindings.set("from", b);
  bindings.set("to", c);
  commands.dispatch(add, nullptr, 0, 1);
  commands.submit();
  commands.wait();
  CHECK(b.as<std::uint32_t>()[63] == 12);
  CHECK(c.as<std::uint32_t>()[63] == 19);
  check_silent(*device);
}

TEST_CASE("synchronization validation sees a missing barrier") {
  gpu::DevicePtr device = open_validated();
  Buffer a(*device, 4096, Domain::device, "a"), b(*device, 4096, Domain::device, "b"),
      c(*device, 4096, Domain::device, "c");
  Pipeline first(*device, "test_add", {{"from", &a}, {"to", &b}}, 0, {64, 1});
  Pipeline second(*device, "test_add", {{"from", &b}, {"to", &c}}, 0, {64, 1});
  Commands commands(*device);
  commands.begin();
  commands.fill(a, 0, 0, a.bytes());
  commands.dispatch(first, nullptr, 0, 16);
  CHECK(gpu::validation_messages(*device) == 0);
  commands.no_barrier();
  commands.dispatch(second, nullptr, 0, 16);  // reads b while it is written
  REQUIRE(gpu::validation_messages(*device) > 0);
  CHECK(gpu::validation_texts(*device).front().find("READ_AFTER_WRITE") != std::string::npos);
}

// For tools/test-validation: an index error must be reported, else the silence on all other kernels proves nothing.
TEST_CASE("GPU-assisted validation sees an index outside a buffer" *
          doctest::skip(std::getenv("CHAINSPLAT_GPU_ASSISTED") == nullptr)) {
  gpu::DevicePtr device = open_validated();
  Buffer x(*device, 64, Domain::device, "x"), y(*device, 64, Domain::device, "y");
  Pipeline saxpy(*device, "test_saxpy", {{"x", &x}, {"y", &y}}, sizeof(SaxpyPush), {16});
  Commands commands(*device);
  commands.begin();
  const SaxpyPush push{17, 1.0f};  // the buffers have sixteen elements
  commands.dispatch(saxpy, &push, sizeof push, 2);
  commands.submit();
  commands.wait();
  CHECK(gpu::validation_messages(*device) > 0);
}

TEST_CASE("two threads share a device") {
  gpu::DevicePtr device = open_validated();
  constexpr std::uint32_t kCount = 4096, kLanes = 64, kTurns = 20;
  core::set_threads(2);
  std::array<bool, 2> right{};
  core::parallel_for(2, [&](std::int64_t thread) {
    Buffer a(*device, kCount * 4, Domain::device, "a"), b(*device, kCount * 4, Domain::device, "b");
    const std::vector<std::uint32_t> start(kCount, static_cast<std::uint32_t>(100 * thread));
    Pipeline forth(*device, "test_add", {{"from", &a}, {"to", &b}}, 0, {kLanes, 1});
    Pipeline back(*device, "test_add", {{"from", &b}, {"to", &a}}, 0, {kLanes, 1});
    gpu::upload(*device, a, start.data(), a.bytes());
    Commands commands(*device);
    commands.begin();
    commands.dispatch(forth, nullptr, 0, kCount / kLanes);
    commands.dispatch(back, nullptr, 0, kCount / kLanes);
    for (std::uint32_t i = 0; i < kTurns; ++i) {
      commands.submit();
      commands.wait();
    }
    right[static_cast<std::size_t>(thread)] =
        read(*device, a) == std::vector<std::uint32_t>(kCount, static_cast<std::uint32_t>(100 * thread) + 2 * kTurns);
  });
  core::set_threads(0);
  CHECK(right[0]);
  CHECK(right[1]);
  check_silent(*device);
}

TEST_CASE("a process opens the device as often as it likes") {
  constexpr int kTimes = 40;  // NVIDIA's driver can be loaded 30 times
  for (int time = 0; time < kTimes; ++time) CHECK(gpu::info(*gpu::open_device()).refused.empty());
}

TEST_CASE("the pipeline cache is kept, and a damaged or unwritable one is no trouble") {
  const Path folder = std::filesystem::temp_directory_path() / ("chainsplat_gpu_test_" + std::to_string(getpid()));
  std::filesystem::remove_all(folder);
  Environment cache("XDG_CACHE_HOME", folder.c_str());
  Environment mesa("MESA_SHADER_CACHE_DISABLE", "true");  // Mesa's own cache would be there too, and it prints
  const auto work = [] {
    gpu::DevicePtr device = open_validated();
    Pipeline add(*device, "test_add", {{"from", nullptr}, {"to", nullptr}}, 0, {64, 1});
    check_silent(*device);
    return device->pipeline_cache_file;
  };
  const Path file = work();
  CHECK(file.parent_path() == folder / "chainsplat");
  // a driver may cache nothing; the file of one that does must read back, and any damage must be detected
  const bool kept = std::filesystem::exists(file);
  MESSAGE(std::string(kept ? "the driver keeps" : "the driver does not keep") << " compiled pipelines in the cache");
  std::filesystem::create_directories(file.parent_path());
  const std::string before = kept ? core::read_file(file) : std::string(1000, 'x');
  work();
  if (kept) CHECK(core::read_file(file) == before);
  std::string damaged = before;
  damaged[damaged.size() / 2] ^= 0x55;
  for (std::size_t bytes : {damaged.size(), std::size_t{9}, std::size_t{5}, std::size_t{0}}) {
    core::write_file(file, damaged.substr(0, bytes));
    work();
    if (kept) CHECK(core::read_file(file) == before);
  }
  std::filesystem::remove_all(folder);
  std::ofstream(folder) << "a file where the folder should be";
  work();
  std::filesystem::remove_all(folder);
  Environment no_home("HOME", nullptr);
  Environment no_cache("XDG_CACHE_HOME", nullptr);
  CHECK(gpu::examine().pipeline_cache.empty());
  work();
}

TEST_CASE("any damage to a cache file is seen") {
  const std::string data = "forty-two bytes of somebody's compiled code";
  const std::string content = gpu::with_checksum(data);
  CHECK(gpu::without_checksum(content) == data);
  for (std::size_t i = 0; i < content.size(); ++i) {
    std::string damaged = content;
    damaged[i] ^= 1;
    CHECK(gpu::without_checksum(damaged).empty());
    CHECK(gpu::without_checksum(content.substr(0, i)).empty());
  }
}

TEST_CASE("what a submit and a dispatch cost") {
  gpu::DevicePtr device = gpu::open_device();  // without validation, which takes longer than the work itself
  constexpr int kDispatches = 50, kTurns = 200;
  Buffer a(*device, 256, Domain::device, "a"), b(*device, 256, Domain::device, "b");  // one work group
  const std::vector<std::uint32_t> zeros(a.bytes() / 4, 0);
  gpu::upload(*device, a, zeros.data(), a.bytes());
  Pipeline forth(*device, "test_add", {{"from", &a}, {"to", &b}}, 0, {64, 1});
  Pipeline back(*device, "test_add", {{"from", &b}, {"to", &a}}, 0, {64, 1});
  const auto best_and_mean = [&](auto body) {
    body();  // the first dispatch compiles
    double best = 1e9, sum = 0.0;
    for (int i = 0; i < kTurns; ++i) {
      const double start = core::seconds_now();
      body();
      const double seconds = core::seconds_now() - start;
      best = std::min(best, seconds);
      sum += seconds;
    }
    return std::pair(1e6 * best, 1e6 * sum / kTurns);
  };
  Commands empty(*device), list(*device), record(*device);
  empty.begin();
  const auto [empty_best, empty_mean] = best_and_mean([&] { empty.submit(), empty.wait(); });
  const auto fill_list = [&](Commands& commands) {
    commands.begin();
    for (int i = 0; i < kDispatches; ++i) commands.dispatch(i % 2 ? back : forth, nullptr, 0, 1);
  };
  fill_list(list);
  const auto [list_best, list_mean] = best_and_mean([&] { list.submit(), list.wait(); });
  const auto [record_best, record_mean] = best_and_mean([&] { fill_list(record); });
  MESSAGE(gpu::info(*device).name << ": empty submit and wait " << empty_best << " us best, " << empty_mean
                                  << " mean; dispatch in a list of 50 " << (list_best - empty_best) / kDispatches
                                  << " best, " << (list_mean - empty_mean) / kDispatches << " mean; recording one "
                                  << record_best / kDispatches << " best, " << record_mean / kDispatches << " mean");
  // every submission of the list ran each of its dispatches once, which takes longer than running none
  CHECK(read(*device, a) == std::vector<std::uint32_t>(a.bytes() / 4, kDispatches * (1 + kTurns)));
  CHECK(list_best > empty_best);
}
