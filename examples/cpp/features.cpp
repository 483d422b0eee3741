// What a board feels, in C++.
//
//   tactile cpp-header --out tactile_messages.hpp
//
// Straight from the bus, where zenoh-cpp (zenohcxx over zenohc or zenohpico) is installed:
//
//   g++ -std=c++17 -DWITH_ZENOH features.cpp -lzenohc -o features
//   ./features CONFIG.json5 tactile/left/features      (docs/connecting.md has the configuration)
//
// Without it, through a pipe; each message comes after its length as four bytes, little-endian:
//
//   g++ -std=c++17 features.cpp -o features
//   tactile echo tactile/left/features --cdr | ./features

#include <cstdio>
#include <vector>

#include "tactile_messages.hpp"

static void show(const std::uint8_t* data, std::size_t size) {
  try {
    const auto f = tactile::decode<tactile::ContactFeatures>(data, size);
    std::printf("%u %s %.4f N, %zu contacts\n", f.sequence, f.valid ? "valid" : "not valid",
                static_cast<double>(f.normal_force), f.patches.size());
    for (const auto& patch : f.patches)
      std::printf("  %.4f N at %.4f %.4f %.4f m\n", static_cast<double>(patch.normal_force),
                  patch.centroid.x, patch.centroid.y, patch.centroid.z);
  } catch (const tactile::DecodeError& error) {
    std::printf("not a message: %s\n", error.what());
  }
  std::fflush(stdout);
}

#ifdef WITH_ZENOH
#include <chrono>
#include <thread>
#include <zenoh.hxx>

int main(int argc, char** argv) {
  if (argc != 3) return std::fprintf(stderr, "usage: features CONFIG.json5 KEY\n"), 2;
  auto session = zenoh::Session::open(zenoh::Config::from_file(argv[1]));
  auto subscriber = session.declare_subscriber(
      zenoh::KeyExpr(argv[2]),
      [](const zenoh::Sample& sample) {
        const auto bytes = sample.get_payload().as_vector();
        show(bytes.data(), bytes.size());
      },
      zenoh::closures::none);
  for (;;) std::this_thread::sleep_for(std::chrono::hours(1));
}
#else
int main() {
  std::uint8_t head[4];
  std::vector<std::uint8_t> body;
  while (std::fread(head, 1, 4, stdin) == 4) {
    const std::uint32_t size = head[0] | head[1] << 8 | head[2] << 16 |
                               static_cast<std::uint32_t>(head[3]) << 24;
    if (size > 65536) return std::fprintf(stderr, "a message of %u bytes\n", size), 1;
    body.resize(size);
    if (std::fread(body.data(), 1, size, stdin) != size) break;
    show(body.data(), body.size());
  }
  return 0;
}
#endif
