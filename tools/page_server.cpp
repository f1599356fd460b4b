#include "page_server.h"

#include <netinet/in.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cctype>
#include <cerrno>
#include <cmath>
#include <cstring>
#include <list>
#include <string_view>
#include <thread>
#include <vector>

namespace chainsplat::tools {

namespace {

constexpr std::size_t kMostConnections = 32;      // a browser opens up to six; beyond, the slowest one makes room
constexpr std::size_t kLongestRequest = 8 << 10;  // bytes of its head; there is no body
constexpr double kToAsk = 5.0;                    // s for a request to come, and for the next one
constexpr double kToRead = 10.0;                  // s for an answer to be taken
constexpr double kToLeave = 1.0;                  // s for a client that gets no further answer to close
constexpr double kFarewell = 0.25;                // s for the last answers when the server ends
constexpr double kBreath = 0.1;                   // s without new connections where the system has no room for one

// A file or socket that is closed with it.
struct Descriptor {
  int number = -1;
  explicit Descriptor(int opened) : number(opened) {}
  Descriptor(const Descriptor&) = delete;
  Descriptor& operator=(const Descriptor&) = delete;
  ~Descriptor() {
    if (number >= 0) ::close(number);
  }
};

const char* reason(int status) {
  switch (status) {
    case 200:
      return "OK";
    case 204:
      return "No Content";
    case 400:
      return "Bad Request";
    case 403:
      return "Forbidden";
    case 404:
      return "Not Found";
    case 405:
      return "Method Not Allowed";
    case 410:
      return "Gone";
    case 431:
      return "Request Header Fields Too Large";
    default:
      return "Internal Server Error";
  }
}

std::string lower(std::string_view text) {
  std::string out(text);
  for (char& letter : out) letter = static_cast<char>(std::tolower(static_cast<unsigned char>(letter)));
  return out;
}

std::string_view trimmed(std::string_view text) {
  while (!text.empty() && (text.front() == ' ' || text.front() == '\t')) text.remove_prefix(1);
  while (!text.empty() && (text.back() == ' ' || text.back() == '\t')) text.remove_suffix(1);
  return text;
}

// A page from elsewhere that has its own name lead to this machine must not see the camera.
bool is_this_host(std::string_view host, int port) {
  for (const std::string_view name : {"127.0.0.1", "localhost"})
    if (host == name || host == std::string(name) + ":" + std::to_string(port)) return true;
  return false;
}

struct Head {
  int status = 200;  // else what is wrong with it
  PageRequest request;
  bool with_content = true;  // false: HEAD
  bool last = false;         // the connection ends with the answer
};

// The lines of a request up to the empty one.
Head parse_head(std::string_view text, int port) {
  Head out;
  out.last = true;  // whoever asks wrongly is not asked what comes next
  const auto next_line = [&] {
    const std::size_t end = std::min(text.find("\r\n"), text.size());
    const std::string_view line = text.substr(0, end);
    text.remove_prefix(std::min(end + 2, text.size()));
    return line;
  };
  const std::string_view first = next_line();
  const std::size_t space = first.find(' '), second = first.rfind(' ');
  const std::string_view method = first.substr(0, space);
  const std::string_view target = space < second ? first.substr(space + 1, second - space - 1) : std::string_view();
  const std::string_view version = space < second ? first.substr(second + 1) : std::string_view();
  int hosts = 0;
  bool close = version == "HTTP/1.0", body = false, broken = false;
  std::string host;
  while (!text.empty()) {
    const std::string_view line = next_line();
    const std::size_t colon = line.find(':');
    broken |= colon == 0 || colon == std::string_view::npos || line.find_first_of(" \t") < colon;
    if (broken) break;
    const std::string name = lower(line.substr(0, colon));
    const std::string_view value = trimmed(line.substr(colon + 1));
    if (name == "host") host = value, ++hosts;
    if (name == "connection" && lower(value).find("close") != std::string::npos) close = true;
    if (name == "transfer-encoding" || (name == "content-length" && value != "0")) body = true;
  }
  out.with_content = method != "HEAD";
  if (broken || hosts > 1 || target.empty() || target[0] != '/' || target.find(' ') != std::string_view::npos ||
      (version != "HTTP/1.1" && version != "HTTP/1.0")) {
    out.status = 400;
  } else if (!is_this_host(host, port)) {
    out.status = 403;
  } else if (method != "GET" && method != "HEAD") {
    out.status = 405;
  } else {
    const std::size_t mark = std::min(target.find('?'), target.size());
    out.request.path = target.substr(0, mark);
    out.request.query = target.substr(std::min(mark + 1, target.size()));
    out.last = close || body;
  }
  return out;
}

struct Connection {
  enum class State { asking, waiting, reading, leaving };
  Descriptor socket;
  State state = State::asking;
  double since = core::seconds_now();  // when this state began
  std::string received;                // not yet understood
  Head head;
  std::string sending;                      // head and content of the answer, which ends with `rest`
  std::shared_ptr<const std::string> rest;  // null: nothing
  std::size_t sent = 0;
  bool finished = false;  // the client sends no more; it may still read
  bool over = false;

  explicit Connection(int accepted) : socket(accepted) {}

  void enter(State next) {
    state = next;
    since = core::seconds_now();
  }

  double patience() const {  // s
    switch (state) {
      case State::asking:
        return kToAsk;
      case State::reading:
        return kToRead;
      case State::leaving:
        return kToLeave;
      default:
        return INFINITY;  // whom we let wait
    }
  }

  short wanted() const { return state == State::waiting ? 0 : state == State::reading ? POLLOUT : POLLIN; }

  void receive() {
    char block[4096];
    for (;;) {
      const ssize_t count = ::recv(socket.number, block, sizeof block, MSG_DONTWAIT);
      if (count < 0 && errno == EINTR) continue;
      if (count < 0 && (errno == EAGAIN || errno == EWOULDBLOCK)) return;
      if (count <= 0) {
        over = count < 0 || state == State::leaving;
        finished = true;
        return;
      }
      if (state == State::leaving) return;  // thrown away; the next block may wait
      received.append(block, static_cast<std::size_t>(count));
      if (received.size() > kLongestRequest) return;
    }
  }

  // Takes the next request out of what was received; false where it is not complete.
  bool understand(int port) {
    received.erase(0, std::min(received.find_first_not_of("\r\n"), received.size()));
    const std::size_t end = received.find("\r\n\r\n");
    if (end == std::string::npos && received.size() <= kLongestRequest) return false;
    if (end == std::string::npos) {
      head = {};
      head.status = 431;
      head.last = true;
    } else {
      head = parse_head(std::string_view(received).substr(0, end), port);
      received.erase(0, end + 4);
    }
    return true;
  }

  void answer(PageAnswer&& answer) {
    const std::size_t length = answer.body.size() + (answer.rest ? answer.rest->size() : 0);
    sending = "HTTP/1.1 " + std::to_string(answer.status) + " " + reason(answer.status) +
              "\r\nCache-Control: no-store\r\nX-Content-Type-Options: nosniff\r\n";
    if (!answer.type.empty()) sending += "Content-Type: " + answer.type + "\r\n";
    if (answer.status == 405) sending += "Allow: GET, HEAD\r\n";
    if (answer.status != 204) sending += "Content-Length: " + std::to_string(length) + "\r\n";
    sending += head.last ? "Connection: close\r\n\r\n" : "Connection: keep-alive\r\n\r\n";
    rest = nullptr;
    if (head.with_content) {
      sending += answer.body;
      rest = std::move(answer.rest);
    }
    sent = 0;
    enter(State::reading);
  }

  // True where all of the answer has been taken.
  bool send() {
    for (;;) {
      const bool in_rest = sent >= sending.size();
      if (in_rest && (!rest || sent == sending.size() + rest->size())) return true;
      const std::string_view left = in_rest ? std::string_view(*rest).substr(sent - sending.size())
                                            : std::string_view(sending).substr(sent);
      const ssize_t count = ::send(socket.number, left.data(), left.size(), MSG_DONTWAIT | MSG_NOSIGNAL);
      if (count < 0 && errno == EINTR) continue;
      if (count < 0) {
        over = errno != EAGAIN && errno != EWOULDBLOCK;
        return false;
      }
      sent += static_cast<std::size_t>(count);
    }
  }

  // As far as it goes without waiting.
  void go_on(const PageResponder& respond, int port) {
    while (!over) {
      if (state == State::asking) {
        if (!understand(port)) {
          over = finished;
          return;
        }
        enter(State::waiting);
      }
      if (state == State::waiting) {
        if (head.status != 200) {
          answer({head.status, {}, {}, {}});
        } else {
          head.request.waited = core::seconds_now() - since;
          std::optional<PageAnswer> found = respond(head.request);
          if (!found) return;
          answer(std::move(*found));
        }
      }
      if (state == State::reading) {
        if (!send()) return;
        rest = nullptr;
        if (head.last) ::shutdown(socket.number, SHUT_WR);  // a close with something unread would take the answer back
        enter(head.last ? State::leaving : State::asking);
      }
      if (state == State::leaving) return;
    }
  }
};

// Throws InputError.
int listen_at(int port) {
  const int out = ::socket(AF_INET, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0);
  const int yes = 1;
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<std::uint16_t>(port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  if (out >= 0 && ::setsockopt(out, SOL_SOCKET, SO_REUSEADDR, &yes, sizeof yes) == 0 &&
      ::bind(out, reinterpret_cast<const sockaddr*>(&address), sizeof address) == 0 && ::listen(out, SOMAXCONN) == 0)
    return out;
  const std::string why = std::strerror(errno);
  if (out >= 0) ::close(out);
  throw InputError("--serve " + std::to_string(port), "the port cannot be had (" + why + ")",
                   "name another port, for example 8765");
}

}  // namespace

struct PageServer::Implementation {
  int port;
  PageResponder respond;
  Descriptor listener, alarm;
  std::list<Connection> connections;
  double next_accept = 0.0;  // s
  std::atomic<bool> ending{false};
  std::thread thread;

  Implementation(int asked, PageResponder responder)
      : port(asked),
        respond(std::move(responder)),
        listener(listen_at(port)),
        alarm(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK)) {
    if (alarm.number < 0)
      throw WorkError("--serve", std::string("no event can be waited for (") + std::strerror(errno) + ")",
                      "allow the program more open files");
  }

  // Who has not even asked, then who has been at it for the longest.
  void make_room() {
    const auto rank = [](const Connection& c) { return std::pair(c.state != Connection::State::asking, c.since); };
    const auto slowest = std::min_element(connections.begin(), connections.end(),
                                          [&](const auto& a, const auto& b) { return rank(a) < rank(b); });
    if (slowest != connections.end()) connections.erase(slowest);
  }

  void accept_some() {
    for (std::size_t i = 0; i < kMostConnections; ++i) {  // a flood leaves time for those who are there
      const int accepted = ::accept4(listener.number, nullptr, nullptr, SOCK_NONBLOCK | SOCK_CLOEXEC);
      if (accepted < 0 && (errno == EINTR || errno == ECONNABORTED)) continue;
      if (accepted < 0) {
        if (errno != EAGAIN && errno != EWOULDBLOCK) {
          make_room();
          next_accept = core::seconds_now() + kBreath;
        }
        return;
      }
      if (connections.size() >= kMostConnections) make_room();
      Connection& fresh = connections.emplace_back(accepted);
      fresh.receive();  // who asks at once has more right to a place than who does not
      fresh.go_on(respond, port);
    }
  }

  void wait(bool accepting) {
    std::vector<pollfd> files{{alarm.number, POLLIN, 0}, {accepting ? listener.number : -1, POLLIN, 0}};
    double until = accepting ? INFINITY : core::seconds_now() + kBreath;
    for (const Connection& c : connections) {
      files.push_back({c.socket.number, c.wanted(), 0});
      until = std::min(until, c.since + c.patience());
      if (c.state == Connection::State::waiting) until = std::min(until, core::seconds_now() + kPageAskedAgain);
    }
    const double left = std::clamp(until - core::seconds_now(), 0.0, 60.0);
    ::poll(files.data(), files.size(), static_cast<int>(std::ceil(1e3 * left)));
    std::uint64_t rung = 0;
    (void)!::read(alarm.number, &rung, sizeof rung);
    auto file = files.begin() + 2;
    for (Connection& c : connections) {
      const short came = (file++)->revents;
      if (came & POLLIN)
        c.receive();
      else if (came & (POLLERR | POLLHUP))
        c.over = true;
    }
  }

  void look_after_all() {
    const double now = core::seconds_now();
    for (Connection& c : connections) {
      c.go_on(respond, port);
      if (now - c.since > c.patience()) c.over = true;
    }
    connections.remove_if([](const Connection& c) { return c.over; });
  }

  void serve() {
    double end = INFINITY;
    for (;;) {
      try {
        const bool last = ending;
        if (last) {
          end = std::min(end, core::seconds_now() + kFarewell);
          look_after_all();
          if (connections.empty() || core::seconds_now() >= end) return;
        }
        const bool accepting = !last && core::seconds_now() >= next_accept;
        wait(accepting);
        if (accepting) accept_some();
        look_after_all();
      } catch (const std::exception&) {  // no memory, say: the page is not worth the program
        connections.clear();
        next_accept = core::seconds_now() + kBreath;
      }
    }
  }
};

PageServer::PageServer(int port, PageResponder respond)
    : implementation_(std::make_unique<Implementation>(port, std::move(respond))) {
  Implementation& self = *implementation_;
  self.thread = std::thread([&self] { self.serve(); });
}

PageServer::~PageServer() {
  implementation_->ending = true;
  wake();
  implementation_->thread.join();
}

void PageServer::wake() {
  const std::uint64_t ring = 1;
  (void)!::write(implementation_->alarm.number, &ring, sizeof ring);
}

}  // namespace chainsplat::tools
