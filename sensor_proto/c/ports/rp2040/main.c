/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Five MLX90393 on I2C 0 of a Raspberry Pi Pico, USB CDC to the host. Untried on silicon: written
 * from the documentation of the Pico SDK, which it needs to compile.
 *
 *     add_executable(board ports/rp2040/main.c)
 *     target_include_directories(board PRIVATE sensor_proto/c)
 *     target_link_libraries(board pico_stdlib pico_unique_id hardware_i2c hardware_watchdog)
 *     pico_enable_stdio_usb(board 1)
 */
#include "hardware/i2c.h"
#include "hardware/watchdog.h"
#include "pico/stdlib.h"
#include "pico/unique_id.h"

#define BOARD_MAX_TAXELS 5
#include "board.h"
#include "mlx90393.h"

#define SDA 4
#define SCL 5
#define BUS_US 2500
#define TRANSFER_US 2000

static struct mlx_chip chips[5];
static struct mlx_array pad;
static struct board board;

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  (void)self;
  for (size_t i = 0; i < count; i++) putchar_raw(bytes[i]);
  return count;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count) {
    int c = getchar_timeout_us(0);
    if (c < 0) break;
    bytes[n++] = (uint8_t)c;
  }
  return n;
}

static uint32_t ticks(void *self) {
  (void)self;
  return time_us_32();
}

static enum mlx_result transfer(void *self, uint8_t address, const uint8_t *out, uint8_t out_count,
                                uint8_t *in, uint8_t in_count) {
  int count;
  (void)self;
  if (!gpio_get(SDA)) return MLX_STUCK;
  count = i2c_write_timeout_us(i2c0, address, out, out_count, true, TRANSFER_US);
  if (count != out_count) return MLX_NACK;
  count = i2c_read_timeout_us(i2c0, address, in, in_count, false, TRANSFER_US);
  return (count == in_count) ? MLX_OK : MLX_NACK;
}

/** Nine clocks by hand, so that a chip in the middle of a byte releases the data line. */
static void recover(void *self) {
  (void)self;
  gpio_set_function(SCL, GPIO_FUNC_SIO);
  for (int i = 0; i < 9; i++) {
    gpio_set_dir(SCL, GPIO_OUT);
    gpio_put(SCL, 0);
    busy_wait_us_32(5);
    gpio_set_dir(SCL, GPIO_IN);
    busy_wait_us_32(5);
  }
  gpio_set_function(SCL, GPIO_FUNC_I2C);
}

static void convert(void *self) {
  (void)self;
  mlx_array_convert(&pad);
}

static bool sample(void *self, uint8_t array, struct tp_taxel *taxels, int16_t *temperature_cc) {
  (void)self;
  (void)array;
  if (!mlx_array_ready(&pad)) return false;
  mlx_array_read(&pad, taxels, temperature_cc);
  return true;
}

static enum tp_answer set_gain(void *self, uint8_t array, const struct tp_set_gain *codes,
                               uint32_t rate_mhz) {
  struct mlx_setting s = {codes->gain, codes->resolution, codes->oversampling, codes->filter};
  (void)self;
  (void)array;
  return mlx_array_set(&pad, &s, rate_mhz, BUS_US);
}

static uint32_t scales(void *self, uint8_t array, uint32_t *xy_nt, uint32_t *z_nt) {
  (void)self;
  (void)array;
  mlx_scales(&pad.setting, xy_nt, z_nt);
  return mlx_max_rate_mhz(&pad.setting, BUS_US);
}

static void reboot(void *self) {
  (void)self;
  watchdog_hw->scratch[0] = 0x7265626F; /* distinguishes this reset from one by the watchdog */
  watchdog_reboot(0, 0, 0);
  for (;;) tight_loop_contents();
}

int main(void) {
  static const struct mlx_setting setting = {4, 0, 0, 3};
  static const struct mlx_bus bus = {NULL, false, transfer, recover, NULL, ticks};
  static const struct board_port port = {NULL, put, get, ticks, sample, convert, set_gain, scales, reboot};
  static const struct board_array arrays[] = {{"pad", 1, 1, 5, 8000, 300, 484}};
  static pico_unique_board_id_t id;
  static struct board_config config = {NULL, "pico-five", "1.0", arrays, 1, 1000000, 150000, 100000};
  uint8_t cause = TP_POWER_ON;
  if (watchdog_hw->scratch[0] == 0x7265626F) {
    cause = TP_BY_COMMAND;
  } else if (watchdog_caused_reboot()) {
    cause = TP_WATCHDOG;
  }
  watchdog_hw->scratch[0] = 0;
  stdio_init_all();
  i2c_init(i2c0, 400000);
  gpio_set_function(SDA, GPIO_FUNC_I2C);
  gpio_set_function(SCL, GPIO_FUNC_I2C);
  gpio_pull_up(SDA);
  gpio_pull_up(SCL);
  pico_get_unique_board_id(&id);
  config.unique_id = id.id;
  for (uint8_t i = 0; i < 5; i++) chips[i].address = (uint8_t)(0x0C + i);
  mlx_array_begin(&pad, &bus, chips, 5, &setting);
  if (!board_begin(&board, &config, &port, cause)) return 1;
  for (;;) board_poll(&board);
}
