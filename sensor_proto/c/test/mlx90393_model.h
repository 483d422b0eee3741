/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Register-level model of MLX90393 chips, to run firmware without hardware.
 *
 * Each chip has its registers, the commands EX, SB, SM, RM, RR, WR and RT, the status byte, the
 * data-ready pin, conversions timed by an oscillator that may be off, and 16-bit outputs that wrap
 * as the chip's do. Faults: no answer, a blocked bus, a chip that resets by itself. The caller
 * supplies field and temperature.
 *
 * Based on the datasheet. Where that is silent (RM before the end of a conversion), the model sets
 * the error bit, as users of the chip report.
 */
#ifndef MLX90393_MODEL_H
#define MLX90393_MODEL_H

#include "../mlx90393.h"

struct model_chip {
  uint8_t address;
  bool dead;          /* does not answer */
  bool holds_bus;     /* holds SDA low until the bus is freed */
  uint16_t registers[10];
  uint8_t mode;       /* 0 idle, MLX_STATUS_BURST or MLX_STATUS_SINGLE */
  bool ready;
  bool was_reset;     /* reported once in the next status byte */
  bool resetting;
  int8_t slow_percent; /* error of the oscillator: conversions take that much longer */
  uint32_t since_us;  /* start of the conversion or of the reset */
  uint16_t raw[4];    /* temperature, x, y, z */
};

struct model_bus {
  struct model_chip *chips;
  uint8_t count;
  bool spi;
  bool no_ready_pin;
  uint32_t (*micros)(void *self);
  /** Field (nT, in the chip's axes) and temperature (hundredths of a degree C) at an instant. */
  void (*field)(void *self, uint8_t chip, uint32_t us, int32_t nt[3], int16_t *temperature_cc);
  void *self;
  uint32_t transfers;
};

static inline struct mlx_setting model_setting_(const struct model_chip *c) {
  struct mlx_setting s;
  s.gain = (uint8_t)(c->registers[0] >> 4 & 7);
  s.resolution = (uint8_t)(c->registers[2] >> 5 & 3);
  s.oversampling = (uint8_t)(c->registers[2] & 3);
  s.filter = (uint8_t)(c->registers[2] >> 2 & 7);
  return s;
}

static inline void model_power_on(struct model_chip *c) {
  uint8_t i;
  for (i = 0; i < 10; i++) c->registers[i] = 0;
  c->registers[0] = 0x007C; /* gain 7, HALLCONF 0xC, as factory-fresh chips */
  c->mode = 0;
  c->ready = false;
  c->was_reset = true;
  c->resetting = false;
}

/** Initialise chip `c` with address `address`, as after power-on. */
static inline void model_make(struct model_chip *c, uint8_t address) {
  c->address = address;
  c->dead = c->holds_bus = false;
  c->slow_percent = 0;
  c->since_us = 0;
  model_power_on(c);
}

static inline uint32_t model_conversion_us_(const struct model_chip *c) {
  struct mlx_setting s = model_setting_(c);
  return (uint32_t)((int32_t)mlx_conversion_us(&s) / 100 * (100 + c->slow_percent));
}

/** Round to nearest and keep 16 bits, as the chip does. */
static inline uint16_t model_count_(int32_t nt, uint32_t lsb_nt, uint8_t resolution) {
  int32_t lsb = (int32_t)lsb_nt;
  int32_t count = (nt >= 0) ? (nt + lsb / 2) / lsb : -((-nt + lsb / 2) / lsb);
  if (resolution == 2) {
    count += 0x8000;
  } else if (resolution == 3) {
    count += 0x4000;
  }
  if (resolution >= 2) {
    if (count < 0) count = 0;
    if (count > 65535) count = 65535;
  }
  return (uint16_t)((uint32_t)count & 0xFFFFUL);
}

/** Advance chip number `i` to the current time. */
static inline void model_advance_(struct model_bus *bus, uint8_t i) {
  struct model_chip *c = &bus->chips[i];
  uint32_t now = bus->micros(bus->self);
  uint32_t took = model_conversion_us_(c);
  uint32_t period = took;
  uint32_t axis;
  struct mlx_setting s;
  uint32_t lsb[2];
  int16_t cc = 2500;
  uint8_t k;
  if (c->resetting && now - c->since_us >= 1500) model_power_on(c);
  if (c->resetting || c->mode == 0) return;
  if ((int32_t)(now - c->since_us) < (int32_t)took) return; /* a burst may have a start ahead */
  s = model_setting_(c);
  if (c->mode == MLX_STATUS_BURST) {
    if ((c->registers[1] & 63U) != 0) period = 20000UL * (c->registers[1] & 63U);
    if (period < took) period = took;
    while (now - c->since_us >= took + period) c->since_us += period;
  } else if (c->ready) {
    return;
  }
  mlx_scales(&s, &lsb[0], &lsb[1]);
  axis = (uint32_t)(2U + (1U << s.filter)) * 64U << s.oversampling;
  for (k = 0; k < 3; k++) { /* x, y, z are converted one after another, z last */
    int32_t nt[3];
    bus->field(bus->self, i, c->since_us + took - (2U - k) * axis, nt, &cc);
    c->raw[1 + k] = model_count_(nt[k], lsb[k == 2], s.resolution);
  }
  c->raw[0] = (uint16_t)(46244 + ((int32_t)cc - 2500) * 452 / 1000);
  c->ready = true;
  if (c->mode == MLX_STATUS_BURST) c->since_us += period;
}

static inline uint8_t model_status_(struct model_chip *c, bool error) {
  uint8_t status = (uint8_t)(c->mode | (error ? MLX_STATUS_ERROR : 0));
  if (c->was_reset) status |= MLX_STATUS_RESET;
  c->was_reset = false;
  return status;
}

/** `transfer` of a `struct mlx_bus` whose self is a `struct model_bus`. */
static inline enum mlx_result model_transfer(void *self, uint8_t address, const uint8_t *out,
                                             uint8_t out_count, uint8_t *in, uint8_t in_count) {
  struct model_bus *bus = (struct model_bus *)self;
  struct model_chip *c = NULL;
  uint8_t command = (uint8_t)(out[0] & 0xF0U);
  uint8_t number;
  uint8_t i;
  uint8_t k;
  bool error = false;
  bus->transfers++;
  for (i = 0; i < bus->count; i++) {
    if (bus->chips[i].holds_bus && !bus->spi) return MLX_STUCK;
  }
  for (i = 0; i < bus->count && c == NULL; i++) {
    if (bus->chips[i].address == address) {
      c = &bus->chips[i];
      model_advance_(bus, i);
    }
  }
  if (c == NULL || c->dead || c->resetting) {
    for (i = 0; i < in_count; i++) in[i] = 0xFF; /* what an SPI master reads from an open line */
    return bus->spi ? MLX_OK : MLX_NACK;
  }
  for (i = 0; i < in_count; i++) in[i] = 0;
  switch (command) {
    case MLX_EX:
      c->mode = 0;
      c->ready = false;
      break;
    case MLX_SB:
    case MLX_SM:
      error = c->mode != 0 && !(c->mode == MLX_STATUS_SINGLE && c->ready);
      if (!error) {
        c->mode = (uint8_t)((command == MLX_SB) ? MLX_STATUS_BURST : MLX_STATUS_SINGLE);
        c->ready = false;
        c->since_us = bus->micros(bus->self);
      }
      break;
    case MLX_RM:
      error = !c->ready;
      if (!error) {
        for (k = 0; k < 8 && k + 1 < in_count; k++) {
          in[1 + k] = (uint8_t)((k & 1) ? c->raw[k / 2] & 255U : c->raw[k / 2] >> 8);
        }
        c->ready = false;
        if (c->mode == MLX_STATUS_SINGLE) c->mode = 0;
      }
      break;
    case MLX_RR:
      number = (uint8_t)((out_count > 1) ? out[1] >> 2 : 63);
      error = number > 9 || c->mode != 0;
      if (!error && in_count > 2) {
        in[1] = (uint8_t)(c->registers[number] >> 8);
        in[2] = (uint8_t)(c->registers[number] & 255U);
      }
      break;
    case MLX_WR:
      number = (uint8_t)((out_count > 3) ? out[3] >> 2 : 63);
      error = number > 9 || c->mode != 0;
      if (!error) c->registers[number] = (uint16_t)((uint16_t)out[1] << 8 | out[2]);
      break;
    case MLX_RT:
      c->resetting = true;
      c->mode = 0;
      c->ready = false;
      c->since_us = bus->micros(bus->self);
      break;
    default:
      error = true;
  }
  if (in_count != 0) in[0] = model_status_(c, error);
  return MLX_OK;
}

/** `recover` of a `struct mlx_bus`: every chip releases the bus. */
static inline void model_recover(void *self) {
  struct model_bus *bus = (struct model_bus *)self;
  uint8_t i;
  for (i = 0; i < bus->count; i++) bus->chips[i].holds_bus = false;
}

/** `data_ready` of a `struct mlx_bus`. */
static inline bool model_data_ready(void *self, uint8_t address) {
  struct model_bus *bus = (struct model_bus *)self;
  uint8_t i;
  for (i = 0; i < bus->count; i++) {
    if (bus->chips[i].address == address) {
      model_advance_(bus, i);
      return bus->chips[i].ready && !bus->chips[i].dead;
    }
  }
  return false;
}

static inline uint32_t model_micros(void *self) {
  struct model_bus *bus = (struct model_bus *)self;
  return bus->micros(bus->self);
}

#endif
