/* SPDX-License-Identifier: Apache-2.0 */
/* Runs the fuzzer's entry point on inputs from a fixed seed, for machines without libFuzzer. */
#include "fuzz.c"

int main(void) {
  static uint8_t input[1600];
  uint32_t n = 2463534242UL;
  int round;
  for (round = 0; round < 1000; round++) {
    size_t size;
    size_t i;
    n ^= n << 13;
    n ^= n >> 17;
    n ^= n << 5;
    size = 1 + n % (round % 10 == 0 ? sizeof input : 200);
    for (i = 0; i < size; i++) {
      n ^= n << 13;
      n ^= n >> 17;
      n ^= n << 5;
      /* Make types and small lengths more frequent than by chance. */
      input[i] = (uint8_t)((n & 0x700U) == 0 ? 0x81U + (n & 7U) : (n & 0x800U) ? n & 15U : n);
    }
    input[0] = (uint8_t)(round & 3);
    (void)LLVMFuzzerTestOneInput(input, size);
  }
  return 0;
}
