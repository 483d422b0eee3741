/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Driver for Melexis MLX90393 magnetometers on I2C or SPI, several chips per bus, in C99.
 *
 * The microcontroller provides one function that transfers bytes (`struct mlx_bus`); the driver
 * never waits for a conversion. There are two ways to sample:
 *
 *   single  `mlx_array_convert` starts a conversion on every chip, `mlx_array_read` fetches the
 *           results; the caller chooses the sampling instant. Boards with board.h do this.
 *   burst   `mlx_burst` lets a chip convert continuously, `mlx_read` fetches when data is ready.
 *
 * Errors are reported per taxel: a chip that does not answer is `TP_READ_FAILED` and is set up
 * again without delaying the others; one without new data is `TP_STALE` and repeats its last
 * values; counts at the end of the range are `TP_SATURATED`. A blocked bus is freed by the port's
 * `recover`, at most once per cycle.
 *
 * Figures and registers: MLX90393 datasheet; HALLCONF 0xC. In resolutions 0 and 1 the chip silently
 * wraps beyond its 16 bits, so that only a count at the very end is recognised as saturated: choose
 * a gain that leaves room. Resolutions 2 and 3 have room beyond the measuring range, so that every
 * reading out of range is recognised.
 */
#ifndef TACTILE_MLX90393_H
#define TACTILE_MLX90393_H

#include "tactile_proto.h"

enum mlx_result {
  MLX_OK,
  MLX_NACK,      /* no answer at this address */
  MLX_STUCK,     /* the bus is blocked */
  MLX_NOT_READY, /* no new conversion */
  MLX_ERROR,     /* the chip refused the command or gave a wrong answer */
  MLX_WAS_RESET  /* the chip has lost its settings */
};

/* Commands; the low four bits select the axes. */
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
#define MLX_TRIG_INT 0x8000U /* the INT/TRG pin signals data-ready */
#define MLX_COMM_SPI 0x4000U
#define MLX_COMM_I2C 0x6000U
#define MLX_RESET_US 1600 /* from RT to the first command */

/** Functions that the microcontroller provides for a bus. */
struct mlx_bus {
  void *self;
  bool spi;
  /**
   * Write `out_count` bytes to the chip, then read `in_count` bytes. I2C: `address` is the 7-bit
   * address; write, repeated start, read, stop. SPI: `address` is the number of a chip select;
   * select, write, keep clocking to read, deselect (mode 3, most significant bit first). Returns
   * MLX_OK, MLX_NACK or MLX_STUCK. It must return whatever the chip does.
   */
  enum mlx_result (*transfer)(void *self, uint8_t address, const uint8_t *out, uint8_t out_count,
                              uint8_t *in, uint8_t in_count);
  /** Optional: free a blocked I2C bus with nine clocks, then a stop. */
  void (*recover)(void *self);
  /** Optional: level of the chip's INT/TRG pin, high while data is ready. */
  bool (*data_ready)(void *self, uint8_t address);
  /** Clock of the microcontroller in us; it may wrap at 2^32. */
  uint32_t (*micros)(void *self);
};

/** Settings in the chip's own codes, as in Set gain. */
struct mlx_setting {
  uint8_t gain;         /* GAIN_SEL, 0 to 7 */
  uint8_t resolution;   /* RES of all axes, 0 to 3 */
  uint8_t oversampling; /* OSR, 0 to 3 */
  uint8_t filter;       /* DIG_FILT, 0 to 7 */
};

enum mlx_state { MLX_DOWN, MLX_RESETTING, MLX_UP };

struct mlx_chip {
  uint8_t address;
  /* The rest is private to the driver. */
  uint8_t state; /* enum mlx_state */
  bool converting;
  uint32_t since; /* micros: time of the reset or start of the conversion */
  struct tp_taxel last;
  int16_t temperature_cc;
};

/** Chips sampled together, in the order of their taxels. */
struct mlx_array {
  const struct mlx_bus *bus;
  struct mlx_chip *chips;
  uint8_t count;
  bool flipped; /* z points into the skin: x and z change sign, as PROTOCOL.md requires */
  struct mlx_setting setting;
  uint32_t recoveries; /* how often the bus had to be freed */
};

/* ---- Figures ------------------------------------------------------------------------------------- */

static inline bool mlx_is_setting(const struct mlx_setting *s) {
  return s->gain <= 7 && s->resolution <= 3 && s->oversampling <= 3 && s->filter <= 7;
}

/** nT per count, for x and y, and for z. */
static inline void mlx_scales(const struct mlx_setting *s, uint32_t *xy_nt, uint32_t *z_nt) {
  static const uint16_t xy[8] = {751, 601, 451, 376, 300, 250, 200, 150};
  static const uint16_t z[8] = {1210, 968, 726, 605, 484, 403, 323, 242};
  *xy_nt = (uint32_t)xy[s->gain & 7] << s->resolution;
  *z_nt = (uint32_t)z[s->gain & 7] << s->resolution;
}

/** Duration in us of one conversion of temperature and three axes, with a nominal oscillator. */
static inline uint32_t mlx_conversion_us(const struct mlx_setting *s) {
  return 688U + 192U * ((uint32_t)(2U + (1U << s->filter)) << s->oversampling);
}

/** The same for the slowest oscillator allowed (+10 %). */
static inline uint32_t mlx_slowest_us(const struct mlx_setting *s) {
  uint32_t us = mlx_conversion_us(s);
  return us + us / 10 + 1;
}

/**
 * Highest rate in mHz at which the slowest chip is read in time; `bus_us`: time to start and read
 * all.
 */
static inline uint32_t mlx_max_rate_mhz(const struct mlx_setting *s, uint32_t bus_us) {
  return 1000000000UL / (mlx_slowest_us(s) + bus_us);
}

/* ---- One chip -------------------------------------------------------------------------------------- */

/** Send a command and read its status byte. */
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

/** Write one register, keeping its bits outside `mask`, and verify it. */
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

/** Start a reset; the chip accepts commands again after MLX_RESET_US. */
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

/** Write the settings and verify them. The chip must neither convert nor burst. */
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

/** Start one conversion of temperature and all axes. */
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
 * Let the chip convert continuously, every `interval` times 20 ms (1 to 63; 0: without a pause).
 * `mlx_exit` ends it.
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

/**
 * Count of one axis; sets `saturated` if out of range. Zero is 0, 8000h or 4000h, depending on RES.
 */
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

/** Temperature in hundredths of a degree C from the raw 16 bits: 25 + (raw - 46244) / 45.2. */
static inline int16_t mlx_temperature_cc(uint16_t raw) {
  int32_t cc = 2500 + ((int32_t)raw - 46244) * 1000 / 452;
  if (cc > 32767) cc = 32767;
  if (cc < -32768) cc = -32768;
  return (int16_t)cc;
}

/**
 * Read the conversion. MLX_OK: `chip->last` and `chip->temperature_cc` are new; otherwise they are
 * unchanged. MLX_WAS_RESET requires `mlx_configure`.
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
  if (in[0] & MLX_STATUS_ERROR) return MLX_NOT_READY; /* RM before the end is refused in this way */
  for (i = 0; i < 4; i++) raw[i] = (uint16_t)((uint16_t)in[1 + 2 * i] << 8 | in[2 + 2 * i]);
  if (raw[0] == 0 || raw[0] == 0xFFFF) return MLX_ERROR; /* -998 or 452 C: idle lines, not a chip */
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

/** Set up the chips without waiting; those that do not answer are tried again in each cycle. */
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

/** Take a chip that is not up through its next step: reset, then settings. */
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
  } else if (chip->converting) { /* the last conversion was not read */
    (void)mlx_exit(a->bus, chip);
  }
  result = mlx_convert(a->bus, chip);
  if (result == MLX_NACK || result == MLX_WAS_RESET) chip->state = MLX_DOWN;
  return result;
}

/** Start a conversion on every chip, one after another; those that are down are set up again. */
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
    for (; i < a->count; i++) a->chips[i].converting = false; /* the bus is still blocked */
    return;
  }
}

/** Whether every conversion must have ended, judged by the pin or the slowest oscillator. */
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
 * Read the conversions: one taxel per chip, each with its status, and the mean temperature of the
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
      chip->last.status = TP_READ_FAILED; /* too old to be repeated later */
      if (chip->state == MLX_UP && result != MLX_STUCK && result != MLX_NOT_READY) {
        chip->state = MLX_DOWN; /* set it up again */
      }
    }
  }
  if (good != 0) *temperature_cc = (int16_t)(sum / good);
}

/**
 * Set all chips, for Set gain; `rate_mhz` and `bus_us` as in `mlx_max_rate_mhz`. TP_BAD_ARGUMENT:
 * invalid codes, or too slow for the rate; nothing has changed then. A chip that does not answer
 * gets the settings when it is back.
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
      (void)mlx_exit(a->bus, chip); /* a conversion in progress would refuse the registers */
      (void)mlx_configure(a->bus, chip, setting);
    }
    chip->last.status = TP_READ_FAILED; /* of the old scale */
  }
  return TP_OK;
}

#endif
