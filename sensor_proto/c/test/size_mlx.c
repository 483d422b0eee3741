/* SPDX-License-Identifier: Apache-2.0 */
/* A board of five MLX90393 on a bus that does nothing: linked to measure board and driver. */
#define BOARD_MAX_TAXELS 5
#include "board.h"
#include "mlx90393.h"

#define size_clock (*(volatile uint32_t *)0x40)
#define size_register (*(volatile uint8_t *)0x44)

static struct mlx_chip chips[5];
static struct mlx_array array;

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
static uint32_t ticks(void *self) {
  (void)self;
  return size_clock;
}
static enum mlx_result transfer(void *self, uint8_t address, const uint8_t *out, uint8_t out_count,
                                uint8_t *in, uint8_t in_count) {
  (void)self;
  (void)address;
  size_register = out[out_count - 1];
  in[in_count - 1] = size_register;
  return (enum mlx_result)size_register;
}
static bool sample(void *self, uint8_t number, struct tp_taxel *taxels, int16_t *temperature_cc) {
  (void)self;
  (void)number;
  if (!mlx_array_ready(&array)) return false;
  mlx_array_read(&array, taxels, temperature_cc);
  return true;
}
static void convert(void *self) {
  (void)self;
  mlx_array_convert(&array);
}
static enum tp_answer set_gain(void *self, uint8_t number, const struct tp_set_gain *codes,
                               uint32_t rate_mhz) {
  struct mlx_setting s;
  (void)self;
  (void)number;
  s.gain = codes->gain;
  s.resolution = codes->resolution;
  s.oversampling = codes->oversampling;
  s.filter = codes->filter;
  return mlx_array_set(&array, &s, rate_mhz, 400);
}
static uint32_t scales(void *self, uint8_t number, uint32_t *xy, uint32_t *z) {
  (void)self;
  (void)number;
  mlx_scales(&array.setting, xy, z);
  return mlx_max_rate_mhz(&array.setting, 400);
}
static void reboot(void *self) { (void)self; }

static const uint8_t unique_id[8] = {1, 2, 3, 4, 5, 6, 7, 8};
static const struct board_array arrays[1] = {{"pad", 1, 1, 5, 8000, 300, 484}};
static const struct board_config config = {unique_id, "size", "1", arrays, 1, 1000000, 300000, 100000};
static const struct board_port port = {NULL, put, get, ticks, sample, convert, set_gain, scales, reboot};
static const struct mlx_bus bus = {NULL, false, transfer, NULL, NULL, ticks};
static struct board board;

int main(void) {
  static const struct mlx_setting setting = {4, 0, 0, 3};
  uint8_t i;
  for (i = 0; i < 5; i++) chips[i].address = (uint8_t)(0x0C + i);
  mlx_array_begin(&array, &bus, chips, 5, &setting);
  if (!board_begin(&board, &config, &port, TP_POWER_ON)) return 1;
  board_log(&board, TP_INFO, "up");
  for (;;) board_poll(&board);
}
