#include "page_server.h"

#include <microhttpd.h>
#include <netinet/in.h>

#include <array>
#include <cerrno>
#include <chrono>
#include <condition_variable>
#include <cstring>
#include <mutex>
#include <string_view>
#include <thread>
#include <vector>

namespace chainsplat::tools {

namespace {

// A browser opens up to six. Far more than that fit, so that clients that only hold their places cannot take them all,
// and far fewer than the files that a program may open.
constexpr unsigned kMostConnections = 300;
constexpr unsigned kSilence = 5;                            // s without a byte either way, until a connection is closed
constexpr auto kFarewell = std::chrono::milliseconds(250);  // for the last answers when the server ends

// A page from elsewhere that has its own name lead to this machine must not see the camera.
bool is_this_host(std::string_view host, int port) {
  for (const std::string_view name : {"127.0.0.1", "localhost"})
    if (host == name || host == std::string(name) + ":" + std::to_string(port)) return true;
  return false;
}

// How many Host headers there are, and how many of them name this machine.
struct Hosts {
  int port = 0, all = 0, known = 0;
};

MHD_Result look_at_header(void* context, MHD_ValueKind, const char* key, const char* value) {
  auto& hosts = *static_cast<Hosts*>(context);
  if (::strcasecmp(key, MHD_HTTP_HEADER_HOST) == 0) {
    ++hosts.all;
    hosts.known += value && is_this_host(value, hosts.port);
  }
  return MHD_YES;
}

MHD_Result send(MHD_Connection* connection, PageAnswer&& given) {
  auto* const answer = new PageAnswer(std::move(given));
  const std::string_view rest = answer->rest ? std::string_view(*answer->rest) : std::string_view();
  const std::array<MHD_IoVec, 2> parts{{{answer->body.data(), answer->body.size()}, {rest.data(), rest.size()}}};
  MHD_Response* const response = MHD_create_response_from_iovec(
      parts.data(), parts.size(), [](void* sent) { delete static_cast<PageAnswer*>(sent); }, answer);
  if (!response) {
    delete answer;
    return MHD_NO;
  }
  MHD_add_response_header(response, MHD_HTTP_HEADER_CACHE_CONTROL, "no-store");
  MHD_add_response_header(response, MHD_HTTP_HEADER_X_CONTENT_TYPE_OPTIONS, "nosniff");
  if (!answer->type.empty()) MHD_add_response_header(response, MHD_HTTP_HEADER_CONTENT_TYPE, answer->type.c_str());
  if (answer->status == MHD_HTTP_METHOD_NOT_ALLOWED)
    MHD_add_response_header(response, MHD_HTTP_HEADER_ALLOW, "GET, HEAD");
  const MHD_Result queued = MHD_queue_response(connection, static_cast<unsigned>(answer->status), response);
  MHD_destroy_response(response);  // the connection holds it now
  return queued;
}

}  // namespace

struct PageServer::Implementation {
  int port = 0;
  PageResponder respond;
  std::mutex mutex;
  std::condition_variable news;
  bool rung = false, ending = false;
  std::vector<MHD_Connection*> waiting;  // suspended: whose answer is not there yet
  MHD_Daemon* daemon = nullptr;
  std::thread waker;

  // What the library calls for every request: when its head has come, when all of it has, and when it is resumed.
  // `state` is the request's own, null in the first call.
  MHD_Result handle(MHD_Connection* connection, const char* path, std::string_view method, std::size_t* upload,
                    void** state) {
    if (!*state) {  // what is refused is refused before its content comes
      Hosts hosts{port};
      MHD_get_connection_values(connection, MHD_HEADER_KIND, look_at_header, &hosts);
      if (hosts.all > 1) return send(connection, {MHD_HTTP_BAD_REQUEST, {}, {}, {}});
      if (hosts.known != 1) return send(connection, {MHD_HTTP_FORBIDDEN, {}, {}, {}});
      if (method != MHD_HTTP_METHOD_GET && method != MHD_HTTP_METHOD_HEAD)
        return send(connection, {MHD_HTTP_METHOD_NOT_ALLOWED, {}, {}, {}});
      *state = new double(core::seconds_now());
      return MHD_YES;
    }
    if (*upload > 0) {  // content that nobody asked for is thrown away
      *upload = 0;
      return MHD_YES;
    }
    const char* const after = MHD_lookup_connection_value(connection, MHD_GET_ARGUMENT_KIND, "after");
    const double since = *static_cast<const double*>(*state);
    std::optional<PageAnswer> answer = respond({path, after ? after : "", core::seconds_now() - since});
    if (answer) return send(connection, std::move(*answer));
    const std::lock_guard lock(mutex);
    if (ending) return MHD_NO;
    MHD_suspend_connection(connection);
    waiting.push_back(connection);
    return MHD_YES;
  }

  void resume_all() {
    for (MHD_Connection* const connection : waiting) MHD_resume_connection(connection);
    waiting.clear();
  }

  // Has those who wait asked again, until the server ends.
  void wake_those_who_wait() {
    std::unique_lock lock(mutex);
    while (!ending) {
      news.wait_for(lock, std::chrono::duration<double>(kPageAskedAgain), [&] { return rung || ending; });
      rung = false;
      resume_all();
    }
  }
};

PageServer::PageServer(int port, PageResponder respond) : implementation_(std::make_unique<Implementation>()) {
  Implementation& self = *implementation_;
  self.port = port;
  self.respond = std::move(respond);
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(static_cast<std::uint16_t>(port));
  address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  const MHD_AccessHandlerCallback handle = [](void* context, MHD_Connection* connection, const char* path,
                                              const char* method, const char*, const char*, std::size_t* upload,
                                              void** state) {
    try {
      return static_cast<Implementation*>(context)->handle(connection, path, method, upload, state);
    } catch (const std::exception&) {  // no memory, say: the page is not worth the program
      return MHD_NO;
    }
  };
  const MHD_RequestCompletedCallback forget = [](void*, MHD_Connection*, void** state, MHD_RequestTerminationCode) {
    delete static_cast<double*>(*state);
  };
  self.daemon = MHD_start_daemon(
      MHD_USE_AUTO_INTERNAL_THREAD | MHD_ALLOW_SUSPEND_RESUME, static_cast<std::uint16_t>(port), nullptr, nullptr,
      handle, &self, MHD_OPTION_SOCK_ADDR, reinterpret_cast<const sockaddr*>(&address), MHD_OPTION_CONNECTION_LIMIT,
      kMostConnections, MHD_OPTION_CONNECTION_TIMEOUT, kSilence, MHD_OPTION_STRICT_FOR_CLIENT, 1,
      MHD_OPTION_NOTIFY_COMPLETED, forget, nullptr, MHD_OPTION_END);
  if (!self.daemon)
    throw InputError("--serve " + std::to_string(port),
                     std::string("the port cannot be had (") + std::strerror(errno) + ")",
                     "name another port, for example 8765");
  self.waker = std::thread([&self] { self.wake_those_who_wait(); });
}

PageServer::~PageServer() {
  Implementation& self = *implementation_;
  {
    const std::lock_guard lock(self.mutex);
    self.ending = true;
  }
  self.news.notify_all();
  self.waker.join();
  {
    const std::lock_guard lock(self.mutex);
    self.resume_all();
  }
  const MHD_DaemonInfo* const info = MHD_get_daemon_info(self.daemon, MHD_DAEMON_INFO_CURRENT_CONNECTIONS);
  if (info && info->num_connections > 0) std::this_thread::sleep_for(kFarewell);
  MHD_stop_daemon(self.daemon);
}

void PageServer::wake() {
  Implementation& self = *implementation_;
  {
    const std::lock_guard lock(self.mutex);
    self.rung = true;
  }
  self.news.notify_all();
}

}  // namespace chainsplat::tools
