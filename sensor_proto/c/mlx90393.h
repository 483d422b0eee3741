/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Driver of Melexis MLX90393 magnetometers over I2C or SPI, several chips on one bus, in C99.
 *
 * The microcontroller gives one function that moves bytes (`struct mlx_bus`); nothing here waits
 * for a conversion. Two ways to sample:
 *
 *   single  `mlx_array_convert` makes every chip begin, `mlx_array_read` fetches what they found;
 *           the sampling instant is yours. This is what a board of board.h does.
 *   burst   `mlx_burst` lets a chip convert by itself, `mlx_read` fetches when it is ready.
 *
 * What goes wrong is told taxel by taxel: a chip that does not answer is `TP_READ_FAILED` and is
 * set up again without holding up the others; one that had nothing new is `TP_STALE` and repeats
 * its last values; counts at the end of their range are `TP_SATURATED`. A bus held down is freed
 * by the port's `recover`, once a cycle.
 *
 * Figures and registers: MLX90393 datasheet; HALLCONF 0xC. In resolutions 0 and 1 the chip wraps
 * beyond its 16 bits without a word, so that only a count at the very end is seen as saturated:
 * choose a gain that leaves room. Resolutions 2 and 3 have room beyond what they can measure, and
 * there every reading out of range is seen.
 */
#ifndef TACTILE_MLX90393_H
#define TACTILE_MLX90393_H

#include "tactile_proto.h"

enum mlx_result {
  MLX_OK,
  MLX_NACK,      /* nobody answers at this address */
  MLX_STUCK,     /* the bus is held down */
  MLX_NOT_READY, /* no new conversion */
  MLX_ERROR,     /* the chip refused the command, or answered otherwise than it must */
  MLX_WAS_RESET  /* the chip has lost its settings */
};

/* Commands; those that name axes take them in the low four bits. */
#define MLX_SB 0x10 /* start burst mode */
#define MLX_SM 0x30 /* start single measurement */
#define MLX_RM 0x40 /* read measurement */
#define MLX_RR 0x50 /* read register */
#define MLX_WR 0x60 /* write register */
#define MLX_EX 0x80 /* exit mode */
#define MLX_RT 0xF0 /* reset */
#define MLX_TXYZ 0x0F

/* Status byte. */
#define MLX_STATUS_BURST 0x80
#define MLX_STATUS_SINGLE 0x20
#define MLX_STATUS_ERROR 0x10
#define MLX_STATUS_RESET 0x04

#define MLX_HALLCONF 0xC
#define MLX_TRIG_INT 0x8000U /* the INT/TRG pin tells data-ready */
#define MLX_COMM_SPI 0x4000U
#define MLX_COMM_I2C 0x6000U
#define MLX_RESET_US 1600 /* from RT to the first command */

/** What a bus needs of the microcontroller. */
struct mlx_bus {
  void *self;
  bool spi;
  /**
   * Write `out_count` bytes to the chip, then read `in_count` of it. I2C: `address` is the 7-bit
   * address; write, repeated start, read, stop. SPI: `address` is the number of a chip select;
   * select, write, go on clocking to read, deselect (mode 3, most significant bit first). MLX_OK,
   * MLX_NACK or MLX_STUCK; it must end by itself, whatever the chip does.
   */
  enum mlx_result (*transfer)(void *self, uint8_t address, const uint8_t *out, uint8_t out_count,
                              uint8_t *in, uint8_t in_count);
  /** Optional: free an I2C bus that is held down: nine clocks, then a stop. */
  void (*recover)(void *self);
  /** Optional: level of the chip's INT/TRG pin, which is high while data is ready. */
  bool (*data_ready)(void *self, uint8_t address);
  /** The microcontroller's clock in us; it may wrap at 2^32. */
  uint32_t (*micros)(void *self);
};

/** Settings in the chip's codes, as in Set gain. */
struct mlx_setting {
  uint8_t gain;         /* GAIN_SEL, 0 to 7 */
  uint8_t resolution;   /* RES of all axes, 0 to 3 */
  uint8_t oversampling; /* OSR, 0 to 3 */
  uint8_t filter;       /* DIG_FILT, 0 to 7 */
};

enum mlx_state { MLX_DOWN, MLX_RESETTING, MLX_UP };

struct mlx_chip {
  uint8_t address;
  /* What follows is the driver's. */
  uint8_t state; /* enum mlx_state */
  bool converting;
  uint32_t since; /* micros: reset, or beginning of the conversion */
  struct tp_taxel last;
  int16_t temperature_cc;
};

/** Chips that sample together, in the order of their taxels. */
struct mlx_array {
  const struct mlx_bus *bus;
  struct mlx_chip *chips;
  uint8_t count;
  bool flipped; /* z points into the skin: x and z change their signs, as PROTOCOL.md asks */
  struct mlx_setting setting;
  uint32_t recoveries; /* times the bus had to be freed */
};

/* ---- Figures ------------------------------------------------------------------------------------- */

static inline bool mlx_is_setting(const struct mlx_setting *s) {
  return s->gain <= 7 && s->resolution <= 3 && s->oversampling <= 3 && s->filter <= 7;
}

/** nT for one count of x and y, and of z. */
static inline void mlx_scales(const struct mlx_setting *s, uint32_t *xy_nt, uint32_t *z_nt) {
  static const uint16_t xy[8] = {751, 601, 451, 376, 300, 250, 200, 150};
  static const uint16_t z[8] = {1210, 968, 726, 605, 484, 403, 323, 242};
  *xy_nt = (uint32_t)xy[s->gain & 7] << s->resolution;
  *z_nt = (uint32_t)z[s->gain & 7] << s->resolution;
}

/** us of one conversion of temperature and three axes by a chip whose oscillator is right. */
static inline uint32_t mlx_conversion_us(const struct mlx_setting *s) {
  return 688U + 192U * ((uint32_t)(2U + (1U << s->filter)) << s->oversampling);
}

/** The same for the slowest oscillator allowed (+10 %). */
static inline uint32_t mlx_slowest_us(const struct mlx_setting *s) {
  uint32_t us = mlx_conversion_us(s);
  return us + us / 10 + 1;
}

/** Highest rate, mHz, at which the slowest chip is read in time; `bus_us`: to start and read all. */
static inline uint32_t mlx_max_rate_mhz(const struct mlx_setting *s, uint32_t bus_us) {
  return 1000000000UL / (mlx_slowest_us(s) + bus_us);
}

/* ---- One chip -------------------------------------------------------------------------------------- */

/** Send a command and take its status byte. */
static inline enum mlx_result mlx_command(const struct mlx_bus *bus, uint8_t address,
                                          const uint8_t *out, uint8_t n, uint8_t *status) {
  enum mlx_result result = bus->transfer(bus->self, address, out, n, status, 1);
  if (result != MLX_OK) return result;
  return (*status & MLX_STATUS_ERROR) ? MLX_ERROR : MLX_OK;
}

static inline enum mlx_result mlx_order(const struct mlx_bus *bus, uint8_t address,
                                        uint8_t command) {
  uint8_t status;
  return mlx_command(bus, address, &command, 1, &status);
}

static inline enum mlx_result mlx_write_register(const struct mlx_bus *bus, uint8_t address,
                                                 uint8_t number, uint16_t value) {
  uint8_t out[4];
  uint8_t status;
  out[0] = MLX_WR;
  out[1] = (uint8_t)(value >> 8);
  out[2] = (uint8_t)(value & 255U);
  out[3] = (uint8_t)(number << 2);
  return mlx_command(bus, address, out, 4, &status);
}

static inline enum mlx_result mlx_read_register(const struct mlx_bus *bus, uint8_t address,
                                                uint8_t number, uint16_t *value) {
  uint8_t out[2];
  uint8_t in[3];
  enum mlx_result result;
  out[0] = MLX_RR;
  out[1] = (uint8_t)(number << 2);
  result = bus->transfer(bus->self, address, out, 2, in, 3);
  if (result != MLX_OK) return result;
  *value = (uint16_t)((uint16_t)in[1] << 8 | in[2]);
  return (in[0] & MLX_STATUS_ERROR) ? MLX_ERROR : MLX_OK;
}

/** Write one register, its bits outside `mask` as they are, and read it back. */
static inline enum mlx_result mlx_change_register(const struct mlx_bus *bus, uint8_t address,
                                                  uint8_t number, uint16_t mask, uint16_t value) {
  uint16_t was;
  enum mlx_result result = mlx_read_register(bus, address, number, &was);
  if (result != MLX_OK) return result;
  value = (uint16_t)((was & (uint16_t)~mask) | value);
  if (value == was) return MLX_OK;
  result = mlx_write_register(bus, address, number, value);
  if (result == MLX_OK) result = mlx_read_register(bus, address, number, &was);
  if (result != MLX_OK) return result;
  return (was == value) ? MLX_OK : MLX_ERROR;
}

/** Begin a reset; the chip takes commands again after MLX_RESET_US. */
static inline enum mlx_result mlx_reset(const struct mlx_bus *bus, struct mlx_chip *chip) {
  enum mlx_result result = mlx_order(bus, chip->address, MLX_EX);
  chip->state = MLX_DOWN;
  chip->converting = false;
  if (result == MLX_NACK || result == MLX_STUCK) return result;
  result = mlx_order(bus, chip->address, MLX_RT);
  if (result == MLX_NACK || result == MLX_STUCK) return result;
  chip->since = bus->micros(bus->self);
  chip->state = MLX_RESETTING;
  return MLX_OK;
}

/** Write the settings and check that they were taken. The chip must neither convert nor burst. */
static inline enum mlx_result mlx_configure(const struct mlx_bus *bus, struct mlx_chip *chip,
                                            const struct mlx_setting *s) {
  uint8_t a = chip->address;
  uint16_t res = s->resolution;
  uint16_t filter = s->filter;
  uint16_t gain = s->gain;
  enum mlx_result result =
      mlx_change_register(bus, a, 0, 0x007F, (uint16_t)(gain << 4 | MLX_HALLCONF));
  if (result == MLX_OK) {
    result = mlx_change_register(
        bus, a, 1, 0xFFFF, (uint16_t)(MLX_TRIG_INT | (bus->spi ? MLX_COMM_SPI : MLX_COMM_I2C)));
  }
  if (result == MLX_OK) {
    result = mlx_change_register(bus, a, 2, 0x1FFF,
                                 (uint16_t)(res << 9 | res << 7 | res << 5 | filter << 2 | s->oversampling));
  }
  chip->state = (uint8_t)((result == MLX_OK) ? MLX_UP : MLX_DOWN);
  return result;
}

/** Begin one conversion of temperature and all axes. */
static inline enum mlx_result mlx_convert(const struct mlx_bus *bus, struct mlx_chip *chip) {
  static const uint8_t command = MLX_SM | MLX_TXYZ;
  uint8_t status;
  enum mlx_result result = mlx_command(bus, chip->address, &command, 1, &status);
  if (result == MLX_OK && (status & MLX_STATUS_RESET)) result = MLX_WAS_RESET;
  chip->converting = result == MLX_OK;
  chip->since = bus->micros(bus->self);
  return result;
}

/**
 * Let the chip convert on and on: `interval` times 20 ms from one beginning to the next (0: without
 * a pause, 1 to 63). `mlx_exit` ends it.
 */
static inline enum mlx_result mlx_burst(const struct mlx_bus *bus, struct mlx_chip *chip,
                                        uint8_t interval) {
  enum mlx_result result =
      mlx_change_register(bus, chip->address, 1, 0x03FF, (uint16_t)(MLX_TXYZ << 6 | interval));
  if (result == MLX_OK) result = mlx_order(bus, chip->address, MLX_SB | MLX_TXYZ);
  chip->converting = result == MLX_OK;
  chip->since = bus->micros(bus->self);
  return result;
}

/** End burst or single measurement. */
static inline enum mlx_result mlx_exit(const struct mlx_bus *bus, struct mlx_chip *chip) {
  chip->converting = false;
  return mlx_order(bus, chip->address, MLX_EX);
}

/** Count of one axis; `saturated` becomes true out of range. Zero is 0, 8000h or 4000h by RES. */
static inline int16_t mlx_axis_(uint16_t raw, uint8_t resolution, bool *saturated) {
  int32_t count = (int16_t)raw;
  int32_t limit = 32767;
  if (resolution == 2) {
    count = (int32_t)raw - 0x8000;
    limit = 22000;
  } else if (resolution == 3) {
    count = (int32_t)raw - 0x4000;
    limit = 11000;
  }
  if (count >= limit || count <= ((limit == 32767) ? -32768 : -limit)) *saturated = true;
  if (count > 32767) count = 32767;
  return (int16_t)count;
}

/** Hundredths of a degree C of the thermometer's 16 bits: 25 + (raw - 46244) / 45.2. */
static inline int16_t mlx_temperature_cc(uint16_t raw) {
  int32_t cc = 2500 + ((int32_t)raw - 46244) * 1000 / 452;
  if (cc > 32767) cc = 32767;
  if (cc < -32768) cc = -32768;
  return (int16_t)cc;
}

/**
 * Read what was converted. MLX_OK: `chip->last` and `chip->temperature_cc` are new. Otherwise they
 * stay; MLX_WAS_RESET asks for `mlx_configure`.
 */
static inline enum mlx_result mlx_read(const struct mlx_bus *bus, struct mlx_chip *chip,
                                       const struct mlx_setting *s, bool flipped) {
  static const uint8_t command = MLX_RM | MLX_TXYZ;
  uint8_t in[9];
  bool saturated = false;
  enum mlx_result result;
  uint16_t raw[4];
  uint8_t i;
  if (bus->data_ready && !bus->data_ready(bus->self, chip->address)) return MLX_NOT_READY;
  result = bus->transfer(bus->self, chip->address, &command, 1, in, 9);
  if (result != MLX_OK) return result;
  if (in[0] & MLX_STATUS_RESET) return MLX_WAS_RESET;
  if (in[0] & MLX_STATUS_ERROR) return MLX_NOT_READY; /* RM before the end is refused so */
  for (i = 0; i < 4; i++) raw[i] = (uint16_t)((uint16_t)in[1 + 2 * i] << 8 | in[2 + 2 * i]);
  if (raw[0] == 0 || raw[0] == 0xFFFF) return MLX_ERROR; /* -998 or 452 C: lines, not a chip */
  chip->converting = (in[0] & MLX_STATUS_BURST) != 0;
  chip->temperature_cc = mlx_temperature_cc(raw[0]);
  chip->last.x = mlx_axis_(raw[1], s->resolution, &saturated);
  chip->last.y = mlx_axis_(raw[2], s->resolution, &saturated);
  chip->last.z = mlx_axis_(raw[3], s->resolution, &saturated);
  if (flipped) {
    chip->last.x = (int16_t)((chip->last.x == -32768) ? 32767 : -chip->last.x);
    chip->last.z = (int16_t)((chip->last.z == -32768) ? 32767 : -chip->last.z);
  }
  chip->last.status = saturated ? TP_SATURATED : 0;
  return MLX_OK;
}

/* ---- An array ---------------------------------------------------------------------------------------- */

/** Bring the chips up, waiting for none; those that do not answer are tried again in each cycle. */
static inline void mlx_array_begin(struct mlx_array *a, const struct mlx_bus *bus,
                                   struct mlx_chip *chips, uint8_t count,
                                   const struct mlx_setting *setting) {
  uint8_t i;
  a->bus = bus;
  a->chips = chips;
  a->count = count;
  a->flipped = false;
  a->setting = *setting;
  a->recoveries = 0;
  for (i = 0; i < count; i++) {
    chips[i].converting = false;
    chips[i].last.x = chips[i].last.y = chips[i].last.z = 0;
    chips[i].last.status = TP_READ_FAILED; /* until there is a value to repeat */
    chips[i].temperature_cc = 2500;
    (void)mlx_reset(bus, &chips[i]);
  }
}

/** Take a chip that is not up one step further: reset, then settings. */
static inline enum mlx_result mlx_raise_(struct mlx_array *a, struct mlx_chip *chip) {
  if (chip->state == MLX_DOWN) return mlx_reset(a->bus, chip);
  if (a->bus->micros(a->bus->self) - chip->since < MLX_RESET_US) return MLX_NOT_READY;
  return mlx_configure(a->bus, chip, &a->setting);
}

static inline enum mlx_result mlx_begin_(struct mlx_array *a, struct mlx_chip *chip) {
  enum mlx_result result = MLX_OK;
  if (chip->state != MLX_UP) {
    result = mlx_raise_(a, chip);
    if (chip->state != MLX_UP) return result;
  } else if (chip->converting) { /* it never came to an end */
    (void)mlx_exit(a->bus, chip);
  }
  result = mlx_convert(a->bus, chip);
  if (result == MLX_NACK || result == MLX_WAS_RESET) chip->state = MLX_DOWN;
  return result;
}

/** Make every chip begin a conversion, one after another; those that are down are brought up. */
static inline void mlx_array_convert(struct mlx_array *a) {
  bool freed = false;
  uint8_t i;
  for (i = 0; i < a->count; i++) {
    struct mlx_chip *chip = &a->chips[i];
    if (mlx_begin_(a, chip) != MLX_STUCK) continue;
    chip->converting = false;
    if (!freed && a->bus->recover) {
      freed = true;
      a->recoveries++;
      a->bus->recover(a->bus->self);
      if (mlx_begin_(a, chip) != MLX_STUCK) continue;
      chip->converting = false;
    }
    for (; i < a->count; i++) a->chips[i].converting = false; /* nobody can be spoken to */
    return;
  }
}

/** Whether every chip that converts must have ended, by its pin or by the slowest oscillator. */
static inline bool mlx_array_ready(const struct mlx_array *a) {
  uint32_t now = a->bus->micros(a->bus->self);
  uint8_t i;
  for (i = 0; i < a->count; i++) {
    const struct mlx_chip *chip = &a->chips[i];
    if (chip->state != MLX_UP || !chip->converting) continue;
    if (now - chip->since >= mlx_slowest_us(&a->setting)) continue;
    if (!a->bus->data_ready || !a->bus->data_ready(a->bus->self, chip->address)) return false;
  }
  return true;
}

/**
 * Fetch the conversions: one taxel a chip, each with its status, and the mean temperature of the
 * chips that were read.
 */
static inline void mlx_array_read(struct mlx_array *a, struct tp_taxel *taxels,
                                  int16_t *temperature_cc) {
  int32_t sum = 0;
  uint8_t good = 0;
  uint8_t i;
  for (i = 0; i < a->count; i++) {
    struct mlx_chip *chip = &a->chips[i];
    enum mlx_result result = MLX_ERROR;
    if (chip->state == MLX_UP && chip->converting) {
      result = mlx_read(a->bus, chip, &a->setting, a->flipped);
    }
    taxels[i] = chip->last;
    if (result == MLX_OK) {
      sum += chip->temperature_cc;
      good++;
    } else if (result == MLX_NOT_READY && !(chip->last.status & TP_READ_FAILED)) {
      taxels[i].status = (uint8_t)(chip->last.status | TP_STALE);
    } else {
      taxels[i].status = TP_READ_FAILED;
      chip->last.status = TP_READ_FAILED; /* too old to be repeated when it comes back */
      if (chip->state == MLX_UP && result != MLX_STUCK && result != MLX_NOT_READY) {
        chip->state = MLX_DOWN; /* to be set up anew */
      }
    }
  }
  if (good != 0) *temperature_cc = (int16_t)(sum / good);
}

/**
 * Set all chips, for Set gain; `rate_mhz` and `bus_us` as in `mlx_max_rate_mhz`. TP_BAD_ARGUMENT:
 * codes that the chip lacks, or too slow for the rate; nothing has changed then. A chip that does
 * not answer takes the settings when it comes back.
 */
static inline enum tp_answer mlx_array_set(struct mlx_array *a, const struct mlx_setting *setting,
                                           uint32_t rate_mhz, uint32_t bus_us) {
  uint8_t i;
  if (!mlx_is_setting(setting) || rate_mhz > mlx_max_rate_mhz(setting, bus_us)) {
    return TP_BAD_ARGUMENT;
  }
  a->setting = *setting;
  for (i = 0; i < a->count; i++) {
    struct mlx_chip *chip = &a->chips[i];
    if (chip->state == MLX_UP) {
      (void)mlx_exit(a->bus, chip); /* a conversion under way would refuse the registers */
      (void)mlx_configure(a->bus, chip, setting);
    }
    chip->last.status = TP_READ_FAILED; /* of the old scale */
  }
  return TP_OK;
}

#endif
