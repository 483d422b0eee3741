/* SPDX-License-Identifier: Apache-2.0 */
/* A board of five taxels whose port does nothing: linked to measure the size of board.h. */
#define BOARD_MAX_TAXELS 5
#ifdef SIZE_CAN
#define BOARD_CAN 1
#define TP_CAN_BYTES 8
#endif
#include "board.h"

#define size_clock (*(volatile uint32_t *)0x40)
#define size_register (*(volatile uint8_t *)0x44)

#if BOARD_CAN
static bool send(void *self, const struct tp_can_frame *frame) {
  (void)self;
  size_register = frame->data[0];
  return size_register != 0;
}
static bool receive(void *self, struct tp_can_frame *frame) {
  (void)self;
  frame->identifier = size_clock;
  frame->size = size_register;
  frame->fd = false;
  frame->data[0] = size_register;
  return size_register != 0;
}
#else
static size_t put(void *self, const uint8_t *bytes, size_t count) {
  (void)self;
  size_register = bytes[count - 1];
  return size_register;
}
static size_t get(void *self, uint8_t *bytes, size_t count) {
  (void)self;
  (void)count;
  bytes[0] = size_register;
  return size_register;
}
#endif
static uint32_t ticks(void *self) {
  (void)self;
  return size_clock;
}
static bool sample(void *self, uint8_t array, struct tp_taxel *taxels, int16_t *temperature_cc) {
  (void)self;
  taxels[0].x = (int16_t)array;
  *temperature_cc = size_register;
  return true;
}
static void reboot(void *self) { (void)self; }

static const uint8_t unique_id[8] = {1, 2, 3, 4, 5, 6, 7, 8};
static const struct board_array arrays[1] = {{"pad", 1, 1, 5, 8000, 300, 484}};
#if BOARD_CAN
static const struct board_config config = {unique_id, "size", "1", arrays, 1, 1000000, 400000, 100000, 1, false};
static const struct board_port port = {NULL, send, receive, ticks, sample, NULL, NULL, NULL, reboot};
#else
static const struct board_config config = {unique_id, "size", "1", arrays, 1, 1000000, 400000, 100000};
static const struct board_port port = {NULL, put, get, ticks, sample, NULL, NULL, NULL, reboot};
#endif
static struct board board;

int main(void) {
  if (!board_begin(&board, &config, &port, TP_POWER_ON)) return 1;
  board_log(&board, TP_INFO, "up");
  for (;;) board_poll(&board);
}
