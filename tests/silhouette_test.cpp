#include <doctest/doctest.h>
#include "chainsplat/silhouette.h"
TEST_CASE("empty") {}
