// page_server.h - a page for a browser on this machine: HTTP on the loopback address, by libmicrohttpd. One thread
// serves all connections and waits for none of them: a client that sends or reads slowly, or not at all, keeps nobody
// else from the page.
#pragma once
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "chainsplat/core.h"

namespace chainsplat::tools {

struct PageRequest {
  std::string path;     // of GET or HEAD
  std::string after;    // what stands behind '?after=', empty where nothing does
  double waited = 0.0;  // s, since it came
};

struct PageAnswer {
  int status = 200;
  std::string type;                         // of the content; empty: there is none
  std::string body;                         // the content begins with it,
  std::shared_ptr<const std::string> rest;  // and goes on with this, which connections share; null: nothing
};

// None: not yet. It is asked again whenever something happens, at the latest after kPageAskedAgain.
using PageResponder = std::function<std::optional<PageAnswer>(const PageRequest&)>;
constexpr double kPageAskedAgain = 0.1;  // s

class PageServer {
 public:
  // Serves http://127.0.0.1:PORT/ until destroyed; `respond` is called in a thread of the server. Throws InputError
  // where the port is not to be had.
  PageServer(int port, PageResponder respond);
  // Answers that are on their way have a moment to arrive; whatever the clients do, it takes no longer.
  ~PageServer();
  // Whoever waits for an answer is looked after now.
  void wake();

 private:
  struct Implementation;
  std::unique_ptr<Implementation> implementation_;
};

}  // namespace chainsplat::tools
