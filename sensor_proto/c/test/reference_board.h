/* SPDX-License-Identifier: Apache-2.0 */
/**
 * The reference board: board.h, the driver of mlx90393.h, and modelled chips instead of real ones.
 * The host, QEMU and AVR builds provide a line and a clock.
 *
 * Its skin is one array of five chips, pressed every four seconds. If REFERENCE_TABLE names a
 * header written by `field_table.py`, it is a skin of the simulator with known forces instead.
 */
#ifndef REFERENCE_BOARD_H
#define REFERENCE_BOARD_H

#ifdef REFERENCE_TABLE
#include REFERENCE_TABLE
#else
#define REFERENCE_ARRAYS 1
#define REFERENCE_CHIPS 5
#endif

#define BOARD_MAX_ARRAYS REFERENCE_ARRAYS
#define BOARD_MAX_TAXELS REFERENCE_CHIPS
#ifdef REFERENCE_ARRAY_CHIPS
#define BOARD_ARRAY_TAXELS REFERENCE_ARRAY_CHIPS
#endif
#include "../board.h"
#include "../mlx90393.h"
#include "mlx90393_model.h"

#ifndef REFERENCE_BUS_US
#define REFERENCE_BUS_US 400 /* time to start and read all chips */
#endif

#ifdef REFERENCE_TABLE
static const struct board_array reference_arrays[REFERENCE_ARRAYS] = {REFERENCE_ENTRIES};
#else
static const struct board_array reference_arrays[1] = {{"pad", 1, 1, 5, 8000, 300, 484}};
static const uint8_t reference_id[8] = {0x74, 0x61, 0x63, 0x74, 0x69, 0x6C, 0x65, 0x01};
#define REFERENCE_MODEL "reference"
#endif

struct reference {
  struct board board;
  struct board_config config;
  struct board_port port;
  struct mlx_bus bus;
  struct mlx_array arrays[REFERENCE_ARRAYS];
  struct mlx_chip chips[REFERENCE_CHIPS];
  struct model_bus model;
  struct model_chip modelled[REFERENCE_CHIPS];
  uint32_t noise;
  void *self; /* for the platform's functions */
  uint32_t (*micros)(void *self);
};

/** Approximately normal noise in nT: the sum of four uniform numbers; sigma is 3.7 uT. */
static inline int32_t reference_noise_(struct reference *r) {
  uint32_t n = r->noise;
  n ^= n << 13;
  n ^= n >> 17;
  n ^= n << 5;
  r->noise = n;
  return 25 * ((int32_t)(n & 255U) + (int32_t)(n >> 8 & 255U) + (int32_t)(n >> 16 & 255U) +
               (int32_t)(n >> 24) - 510);
}

static inline void reference_field_(void *self, uint8_t chip, uint32_t us, int32_t nt[3],
                                    int16_t *temperature_cc) {
  struct reference *r = (struct reference *)self;
  uint8_t k;
#ifdef REFERENCE_TABLE
  uint32_t ms = us / 1000 % (REFERENCE_FRAME_MS * REFERENCE_FRAMES);
  uint32_t frame = ms / REFERENCE_FRAME_MS;
  int32_t after = (int32_t)(ms % REFERENCE_FRAME_MS);
  uint32_t next = (frame + 1) % REFERENCE_FRAMES;
  *temperature_cc = REFERENCE_CC;
  for (k = 0; k < 3; k++) {
    int32_t from = reference_field_nt[frame][chip][k];
    int32_t to = reference_field_nt[next][chip][k];
    nt[k] = from + (to - from) / REFERENCE_FRAME_MS * after;
  }
#else
  /* Up to 5 N on the middle chip: of four seconds, one rising and one falling. */
  uint32_t ms = us / 1000 % 4000;
  int32_t press = (int32_t)((ms < 2000) ? 0 : (ms < 3000) ? ms - 2000 : 4000 - ms);
  *temperature_cc = 2710;
  nt[0] = 12000 + (int32_t)700 * chip;
  nt[1] = -9000 + (int32_t)300 * chip;
  nt[2] = 10200000 + (int32_t)2000 * chip + (int32_t)((chip == 2) ? 760 : 40) * press;
#endif
  for (k = 0; k < 3; k++) nt[k] += reference_noise_(r);
}

static inline uint32_t reference_micros_(void *self) {
  struct reference *r = (struct reference *)self;
  return r->micros(r->self);
}

static inline uint32_t reference_ticks_(void *self) { return reference_micros_(self); }

static inline void reference_convert_(void *self) {
  struct reference *r = (struct reference *)self;
  uint8_t i;
  for (i = 0; i < REFERENCE_ARRAYS; i++) mlx_array_convert(&r->arrays[i]);
}

static inline bool reference_sample_(void *self, uint8_t array, struct tp_taxel *taxels,
                                     int16_t *temperature_cc) {
  struct reference *r = (struct reference *)self;
  if (!mlx_array_ready(&r->arrays[array])) return false;
  mlx_array_read(&r->arrays[array], taxels, temperature_cc);
  return true;
}

static inline enum tp_answer reference_set_gain_(void *self, uint8_t array,
                                                 const struct tp_set_gain *codes,
                                                 uint32_t rate_mhz) {
  struct reference *r = (struct reference *)self;
  struct mlx_setting setting;
  uint8_t i;
  setting.gain = codes->gain;
  setting.resolution = codes->resolution;
  setting.oversampling = codes->oversampling;
  setting.filter = codes->filter;
  for (i = 0; i < REFERENCE_ARRAYS; i++) {
    if (array == i || array == BOARD_ALL_ARRAYS) {
      /* The first array refuses if any does: codes and rate are the same for all. */
      enum tp_answer result = mlx_array_set(&r->arrays[i], &setting, rate_mhz, REFERENCE_BUS_US);
      if (result != TP_OK) return result;
    }
  }
  return TP_OK;
}

static inline uint32_t reference_scales_(void *self, uint8_t array, uint32_t *lsb_xy_nt,
                                         uint32_t *lsb_z_nt) {
  struct reference *r = (struct reference *)self;
  uint32_t slowest = 0xFFFFFFFFUL;
  uint8_t i;
  mlx_scales(&r->arrays[array].setting, lsb_xy_nt, lsb_z_nt);
  for (i = 0; i < REFERENCE_ARRAYS; i++) {
    uint32_t rate = mlx_max_rate_mhz(&r->arrays[i].setting, REFERENCE_BUS_US);
    if (rate < slowest) slowest = rate;
  }
  return slowest;
}

/**
 * Start at power-on or after a reset with cause `cause`. The platform has set `port` and `micros`.
 */
static inline bool reference_begin(struct reference *r, uint8_t cause) {
  static const struct mlx_setting setting = {4, 0, 0, 3};
  uint8_t first = 0;
  uint8_t i;
  r->config.unique_id = reference_id;
  r->config.model = REFERENCE_MODEL;
  r->config.firmware = "ref 1.0";
  r->config.arrays = reference_arrays;
  r->config.count = REFERENCE_ARRAYS;
  r->config.tick_hz = 1000000;
  r->config.max_rate_mhz = 250000;
  r->config.default_rate_mhz = 100000;
  r->port.ticks = reference_ticks_;
  r->port.convert = reference_convert_;
  r->port.sample = reference_sample_;
  r->port.set_gain = reference_set_gain_;
  r->port.scales = reference_scales_;
  if (cause != TP_BY_COMMAND) { /* a reset of the microcontroller does not reset the chips */
    r->noise = 2463534242UL;
    r->model.chips = r->modelled;
    r->model.count = REFERENCE_CHIPS;
    r->model.spi = false;
    r->model.micros = reference_micros_;
    r->model.field = reference_field_;
    r->model.self = r;
    r->bus.self = &r->model;
    r->bus.spi = false;
    r->bus.transfer = model_transfer;
    r->bus.recover = model_recover;
    r->bus.data_ready = model_data_ready;
    r->bus.micros = model_micros;
    for (i = 0; i < REFERENCE_CHIPS; i++) model_make(&r->modelled[i], i);
  }
  for (i = 0; i < REFERENCE_ARRAYS; i++) {
    uint8_t n = (uint8_t)(reference_arrays[i].rows * reference_arrays[i].columns);
    uint8_t k;
    for (k = 0; k < n; k++) r->chips[first + k].address = (uint8_t)(first + k);
    mlx_array_begin(&r->arrays[i], &r->bus, r->chips + first, n, &setting);
    first = (uint8_t)(first + n);
  }
  return board_begin(&r->board, &r->config, &r->port, cause);
}

#endif
