/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Wire protocol of taxel boards, version 1.0 (PROTOCOL.md), in C99.
 *
 * One header without allocation, own memory or dependencies beyond <stdint.h>. It serves both ends:
 * a writer and a reader for each message, COBS frames for serial lines, transfers for CAN 2.0B and
 * CAN FD. A writer produces header, payload, CRC and stuffing in one pass. A receiver takes one
 * byte (or one CAN frame) at a time and never uses more than the memory it was given, however long
 * the frame.
 *
 * Sending on a serial line:
 *
 *     uint8_t frame[TP_SERIAL_BYTES(4)];
 *     struct tp_writer w;
 *     tp_begin(&w, frame, sizeof frame, TP_ACK, 0, 4, true);
 *     tp_put_ack(&w, TP_START, TP_OK, request);
 *     size = tp_end(&w);                       // 0: the frame is too small for it
 *
 * Receiving:
 *
 *     uint8_t held[32];
 *     struct tp_serial_rx rx;
 *     tp_serial_reset(&rx, held, sizeof held);
 *     if (tp_serial_push(&rx, byte) == TP_PACKET) { ... rx.packet, tp_payload(&rx.packet) ... }
 *
 * `board.h` builds a complete board on it.
 */
#ifndef TACTILE_PROTO_H
#define TACTILE_PROTO_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#ifdef __AVR__
#include <avr/pgmspace.h>
#endif

#define TP_MAJOR 1
#define TP_MINOR 0

#define TP_HEADER 4
#define TP_OVERHEAD 8
#define TP_MAX_PAYLOAD 1024
#define TP_MAX_PACKET 1032
#define TP_MAX_FRAME 1037 /* on a serial line, without its zero */
#define TP_MAX_TAXELS 128
#define TP_MAX_ARRAYS 16
#define TP_MAX_TEXT 255
#define TP_NAME 16 /* bytes of a name on the wire, including its ending zero */
#define TP_BROADCAST 127

/** Size of a packet with a payload of n bytes. */
#define TP_PACKET_BYTES(n) ((n) + TP_OVERHEAD)
/** Size of the serial frame of a payload of n bytes, including its zero. */
#define TP_SERIAL_BYTES(n) (TP_PACKET_BYTES(n) + 2 + TP_PACKET_BYTES(n) / 254)

/* Payload bytes of each message. */
#define TP_DESCRIPTOR_FROZEN 26
#define TP_DESCRIPTOR_BYTES(arrays) (52 + 32 * (arrays))
#define TP_SAMPLES_BYTES(taxels) (12 + 7 * (taxels))
#define TP_STATUS_BYTES 29
#define TP_CLOCK_REPLY_BYTES 12
#define TP_LOG_BYTES(text) (6 + (text))
#define TP_ACK_BYTES 4
#define TP_IDENTIFY_BYTES 4
#define TP_REQUEST_BYTES 2 /* Start, Stop, Reboot */
#define TP_SET_RATE_BYTES 6
#define TP_SET_GAIN_BYTES 7
#define TP_CLOCK_POLL_BYTES 4

enum tp_type {
  TP_DESCRIPTOR = 0x01,
  TP_SAMPLES = 0x02,
  TP_STATUS = 0x03,
  TP_CLOCK_REPLY = 0x04,
  TP_LOG = 0x05,
  TP_ACK = 0x06,
  TP_IDENTIFY = 0x81,
  TP_START = 0x82,
  TP_STOP = 0x83,
  TP_SET_RATE = 0x84,
  TP_SET_GAIN = 0x85,
  TP_CLOCK_POLL = 0x86,
  TP_REBOOT = 0x87
};

/** Results of an Ack. */
enum tp_answer { TP_OK = 0, TP_UNKNOWN_COMMAND = 1, TP_BAD_ARGUMENT = 2, TP_BUSY = 3, TP_FAILED = 4 };

/** Status bits of a taxel. */
enum tp_taxel_status { TP_SATURATED = 1, TP_STALE = 2, TP_READ_FAILED = 4 };

enum tp_reset_cause { TP_POWER_ON = 0, TP_BY_COMMAND = 1, TP_WATCHDOG = 2, TP_BROWN_OUT = 3 };

enum tp_level { TP_DEBUG = 10, TP_INFO = 20, TP_WARNING = 30, TP_ERROR = 40 };

/**
 * Result of a byte or frame. From TP_COBS on: why it was rejected, named as in PROTOCOL.md section
 * 8. Each is returned once per rejected item, so that counting them gives the totals.
 */
enum tp_event {
  TP_NOTHING,
  TP_PACKET,
  TP_COBS,
  TP_OVERSIZED,
  TP_RUNT,
  TP_LENGTH,
  TP_CRC,
  TP_BOARD,
  TP_TYPE_MISMATCH,
  TP_UNKNOWN_TYPE,
  TP_SHORT_PAYLOAD,
  TP_BAD_VALUE,
  TP_EMPTY,
  TP_FOREIGN,
  TP_ERROR_FRAME, /* for the caller: a report of the CAN controller */
  TP_BAD_FRAME,
  TP_NO_START,
  TP_INTERRUPTED, /* never returned, as it may coincide with a packet: see tp_can_rx */
  TP_OUT_OF_ORDER,
  TP_DUPLICATE,
  TP_EVENTS
};

/* ---- Little-endian numbers ------------------------------------------------------------------ */

static inline uint16_t tp_get_u16(const uint8_t *at) {
  return (uint16_t)(at[0] | ((uint16_t)at[1] << 8));
}

static inline uint32_t tp_get_u32(const uint8_t *at) {
  return tp_get_u16(at) | ((uint32_t)tp_get_u16(at + 2) << 16);
}

static inline int16_t tp_get_i16(const uint8_t *at) { return (int16_t)tp_get_u16(at); }

/* ---- CRC-32C ---------------------------------------------------------------------------------- */

#define TP_CRC_SEED 0xFFFFFFFFUL
#define TP_CRC_GOOD 0xB798B438UL /* register after a whole packet including its crc */

/** Register after one more byte. Two lookups in a table of 16 entries, 64 bytes of flash. */
static inline uint32_t tp_crc_step(uint32_t crc, uint8_t byte) {
#ifdef __AVR__
  static const uint32_t table[16] PROGMEM = {
#else
  static const uint32_t table[16] = {
#endif
      0x00000000UL, 0x105EC76FUL, 0x20BD8EDEUL, 0x30E349B1UL, 0x417B1DBCUL, 0x5125DAD3UL,
      0x61C69362UL, 0x7198540DUL, 0x82F63B78UL, 0x92A8FC17UL, 0xA24BB5A6UL, 0xB21572C9UL,
      0xC38D26C4UL, 0xD3D3E1ABUL, 0xE330A81AUL, 0xF36E6F75UL};
#ifdef __AVR__
#define TP_TABLE(i) pgm_read_dword(&table[i])
#else
#define TP_TABLE(i) table[i]
#endif
  crc = (crc >> 4) ^ TP_TABLE((crc ^ byte) & 15U);
  return (crc >> 4) ^ TP_TABLE((crc ^ (uint8_t)(byte >> 4)) & 15U);
#undef TP_TABLE
}

/** CRC-32C of n bytes, as sent in the packet. */
static inline uint32_t tp_crc(const uint8_t *bytes, size_t n) {
  uint32_t crc = TP_CRC_SEED;
  size_t i;
  for (i = 0; i < n; i++) crc = tp_crc_step(crc, bytes[i]);
  return crc ^ 0xFFFFFFFFUL;
}

/* ---- Writer ------------------------------------------------------------------------------------ */

/** A packet being written: plain (for CAN) or as the COBS frame of a serial line. */
struct tp_writer {
  uint8_t *out;
  uint16_t capacity;
  uint16_t size;
  uint16_t code_at; /* where the code of the current COBS block goes */
  uint16_t due;     /* payload bytes still to be written */
  uint32_t crc;
  bool stuffed;
  bool failed; /* no room, or not the announced length */
};

static inline void tp_store_(struct tp_writer *w, uint8_t byte) {
  if (w->size < w->capacity) {
    w->out[w->size++] = byte;
  } else {
    w->failed = true;
  }
}

static inline void tp_stuff_(struct tp_writer *w, uint8_t byte) {
  if (!w->stuffed) {
    tp_store_(w, byte);
    return;
  }
  if (w->size - w->code_at == 255 && !w->failed) { /* full block: no zero follows it */
    w->out[w->code_at] = 255;
    w->code_at = w->size;
    tp_store_(w, 0);
  }
  if (byte != 0) {
    tp_store_(w, byte);
  } else if (!w->failed) {
    w->out[w->code_at] = (uint8_t)(w->size - w->code_at);
    w->code_at = w->size;
    tp_store_(w, 0);
  }
}

static inline void tp_put_(struct tp_writer *w, uint8_t byte) {
  w->crc = tp_crc_step(w->crc, byte);
  tp_stuff_(w, byte);
}

static inline void tp_u8(struct tp_writer *w, uint8_t value) {
  if (w->due == 0) {
    w->failed = true;
    return;
  }
  w->due--;
  tp_put_(w, value);
}

static inline void tp_u16(struct tp_writer *w, uint16_t value) {
  tp_u8(w, (uint8_t)(value & 255U));
  tp_u8(w, (uint8_t)(value >> 8));
}

static inline void tp_u32(struct tp_writer *w, uint32_t value) {
  tp_u16(w, (uint16_t)(value & 0xFFFFUL));
  tp_u16(w, (uint16_t)(value >> 16));
}

static inline void tp_bytes(struct tp_writer *w, const void *bytes, uint16_t n) {
  const uint8_t *at = (const uint8_t *)bytes;
  while (n-- != 0) tp_u8(w, *at++);
}

/**
 * Write a name: at most 15 characters of `text`, then zeros. Replaces all but printable ASCII by
 * '?'.
 */
static inline void tp_name(struct tp_writer *w, const char *text) {
  uint8_t i;
  for (i = 0; i < TP_NAME; i++) {
    char c = (i < TP_NAME - 1) ? *text : '\0';
    if (c != '\0') text++;
    tp_u8(w, (uint8_t)((c != '\0' && (c < ' ' || c > '~')) ? '?' : c));
  }
}

/**
 * Begin a packet of `length` payload bytes from (or to) `board` in `out`. `stuffed`: as a frame for
 * a serial line, with `board` 0; otherwise plain, for `tp_can_segment`.
 */
static inline void tp_begin(struct tp_writer *w, uint8_t *out, uint16_t capacity, uint8_t type,
                            uint8_t board, uint16_t length, bool stuffed) {
  w->out = out;
  w->capacity = capacity;
  w->size = 0;
  w->code_at = 0;
  w->crc = TP_CRC_SEED;
  w->stuffed = stuffed;
  w->failed = length > TP_MAX_PAYLOAD;
  if (stuffed) tp_store_(w, 0);
  tp_put_(w, type);
  tp_put_(w, board);
  tp_put_(w, (uint8_t)(length & 255U));
  tp_put_(w, (uint8_t)(length >> 8));
  w->due = length;
}

/**
 * End the packet and return its size in bytes; 0 if it had no room or its payload another length.
 */
static inline uint16_t tp_end(struct tp_writer *w) {
  uint32_t crc = w->crc ^ 0xFFFFFFFFUL;
  uint8_t i;
  for (i = 0; i < 4; i++) {
    tp_stuff_(w, (uint8_t)(crc & 255U));
    crc >>= 8;
  }
  if (w->stuffed && !w->failed) {
    w->out[w->code_at] = (uint8_t)(w->size - w->code_at);
    tp_store_(w, 0);
  }
  return (w->failed || w->due != 0) ? 0 : w->size;
}

/* ---- Messages ------------------------------------------------------------------------------------ */

struct tp_descriptor {
  uint8_t major;
  uint8_t minor;
  uint8_t unique_id[8];
  char model[TP_NAME];
  char firmware[TP_NAME]; /* this and the rest only if major is TP_MAJOR */
  uint32_t tick_hz;
  uint32_t max_rate_mhz;
  uint8_t count; /* number of arrays; read each with tp_get_array */
  uint8_t stride_bytes;
};

struct tp_array {
  uint8_t array;
  uint8_t chip; /* 0 unknown, 1 MLX90393 */
  uint8_t rows;
  uint8_t columns;
  uint32_t pitch_um;
  uint32_t lsb_xy_nt;
  uint32_t lsb_z_nt;
  char name[TP_NAME];
};

/** Head of Samples; tp_get_taxel reads the field and status of a taxel. */
struct tp_samples {
  uint8_t array;
  uint8_t taxels;
  int16_t temperature_cc;
  uint32_t sequence;
  uint32_t ticks;
};

struct tp_taxel {
  int16_t x;
  int16_t y;
  int16_t z;
  uint8_t status;
};

struct tp_status {
  uint32_t uptime_ms_low;
  uint32_t uptime_ms_high;
  uint32_t cycles;
  uint32_t overruns;
  uint32_t rx_errors;
  uint32_t chip_errors;
  uint32_t rate_mhz;
  uint8_t reset_cause;
};

struct tp_clock_reply {
  uint32_t token;
  uint32_t ticks_received;
  uint32_t ticks_sent;
};

struct tp_log {
  uint8_t level;
  uint8_t size_bytes;
  uint32_t ticks;
  const uint8_t *text; /* without an ending zero; may hold characters that are not printable */
};

struct tp_ack {
  uint8_t command;
  uint8_t result;
  uint16_t request;
};

struct tp_identify {
  uint16_t request;
  uint8_t major;
  uint8_t minor;
};

struct tp_set_rate {
  uint16_t request;
  uint32_t rate_mhz;
};

struct tp_set_gain {
  uint16_t request;
  uint8_t array;
  uint8_t gain;
  uint8_t resolution;
  uint8_t oversampling;
  uint8_t filter;
};

/** Write bytes 0 to 51 of a Descriptor; `tp_put_array` for each array must follow. */
static inline void tp_put_descriptor(struct tp_writer *w, const struct tp_descriptor *m) {
  tp_u8(w, m->major);
  tp_u8(w, m->minor);
  tp_bytes(w, m->unique_id, 8);
  tp_name(w, m->model);
  tp_name(w, m->firmware);
  tp_u32(w, m->tick_hz);
  tp_u32(w, m->max_rate_mhz);
  tp_u8(w, m->count);
  tp_u8(w, 32);
}

static inline void tp_put_array(struct tp_writer *w, const struct tp_array *m) {
  tp_u8(w, m->array);
  tp_u8(w, m->chip);
  tp_u8(w, m->rows);
  tp_u8(w, m->columns);
  tp_u32(w, m->pitch_um);
  tp_u32(w, m->lsb_xy_nt);
  tp_u32(w, m->lsb_z_nt);
  tp_name(w, m->name);
}

/**
 * Write bytes 0 to 11 of Samples; x, y, z of every taxel, then the status of every taxel, must
 * follow.
 */
static inline void tp_put_samples(struct tp_writer *w, const struct tp_samples *m) {
  tp_u8(w, m->array);
  tp_u8(w, m->taxels);
  tp_u16(w, (uint16_t)m->temperature_cc);
  tp_u32(w, m->sequence);
  tp_u32(w, m->ticks);
}

static inline void tp_put_status(struct tp_writer *w, const struct tp_status *m) {
  tp_u32(w, m->uptime_ms_low);
  tp_u32(w, m->uptime_ms_high);
  tp_u32(w, m->cycles);
  tp_u32(w, m->overruns);
  tp_u32(w, m->rx_errors);
  tp_u32(w, m->chip_errors);
  tp_u32(w, m->rate_mhz);
  tp_u8(w, m->reset_cause);
}

static inline void tp_put_clock_reply(struct tp_writer *w, uint32_t token, uint32_t ticks_received,
                                      uint32_t ticks_sent) {
  tp_u32(w, token);
  tp_u32(w, ticks_received);
  tp_u32(w, ticks_sent);
}

/** Write bytes 0 to 5 of a Log; its text must follow. */
static inline void tp_put_log(struct tp_writer *w, uint8_t level, uint8_t size_bytes,
                              uint32_t ticks) {
  tp_u8(w, level);
  tp_u8(w, size_bytes);
  tp_u32(w, ticks);
}

static inline void tp_put_ack(struct tp_writer *w, uint8_t command, uint8_t result,
                              uint16_t request) {
  tp_u8(w, command);
  tp_u8(w, result);
  tp_u16(w, request);
}

static inline void tp_put_identify(struct tp_writer *w, const struct tp_identify *m) {
  tp_u16(w, m->request);
  tp_u8(w, m->major);
  tp_u8(w, m->minor);
}

static inline void tp_put_set_rate(struct tp_writer *w, const struct tp_set_rate *m) {
  tp_u16(w, m->request);
  tp_u32(w, m->rate_mhz);
}

static inline void tp_put_set_gain(struct tp_writer *w, const struct tp_set_gain *m) {
  tp_u16(w, m->request);
  tp_u8(w, m->array);
  tp_u8(w, m->gain);
  tp_u8(w, m->resolution);
  tp_u8(w, m->oversampling);
  tp_u8(w, m->filter);
}

/* Readers: `p` is the payload, `n` its length. They return TP_PACKET or the reason for rejection.
 * Bytes after the fields of version 1.0 belong to a newer minor version and are ignored. */

static inline bool tp_get_name_(const uint8_t *at, char *name) {
  bool ended = false;
  uint8_t i;
  for (i = 0; i < TP_NAME; i++) {
    if (at[i] == 0) {
      ended = true;
    } else if (ended || at[i] < 0x20 || at[i] > 0x7E) {
      return false;
    }
    name[i] = (char)at[i];
  }
  return ended;
}

/** Read entry `i` of a Descriptor; TP_BAD_VALUE if section 4 excludes it. */
static inline enum tp_event tp_get_array(const uint8_t *p, uint16_t n, uint8_t i,
                                         struct tp_array *m) {
  uint16_t from;
  uint16_t taxels;
  if (n < 52) return TP_SHORT_PAYLOAD;
  from = (uint16_t)(52U + (uint16_t)i * p[51]);
  if (n < from || n - from < 32) return TP_SHORT_PAYLOAD;
  p += from;
  m->array = p[0];
  m->chip = (uint8_t)((p[1] == 1) ? 1 : 0);
  m->rows = p[2];
  m->columns = p[3];
  m->pitch_um = tp_get_u32(p + 4);
  m->lsb_xy_nt = tp_get_u32(p + 8);
  m->lsb_z_nt = tp_get_u32(p + 12);
  taxels = (uint16_t)((uint16_t)m->rows * m->columns);
  if (!tp_get_name_(p + 16, m->name) || taxels < 1 || taxels > TP_MAX_TAXELS || m->pitch_um == 0 ||
      m->lsb_xy_nt == 0 || m->lsb_z_nt == 0) {
    return TP_BAD_VALUE;
  }
  return TP_PACKET;
}

/**
 * Read a Descriptor and check all its entries. If the major version differs, only bytes 0 to 25 are
 * read and `count` is 0.
 */
static inline enum tp_event tp_get_descriptor(const uint8_t *p, uint16_t n,
                                              struct tp_descriptor *m) {
  uint8_t i;
  uint8_t k;
  if (n < TP_DESCRIPTOR_FROZEN) return TP_SHORT_PAYLOAD;
  m->major = p[0];
  m->minor = p[1];
  for (i = 0; i < 8; i++) m->unique_id[i] = p[2 + i];
  if (!tp_get_name_(p + 10, m->model)) return TP_BAD_VALUE;
  m->firmware[0] = '\0';
  m->tick_hz = m->max_rate_mhz = 0;
  m->count = m->stride_bytes = 0;
  if (m->major != TP_MAJOR) return TP_PACKET;
  if (n < 52) return TP_SHORT_PAYLOAD;
  m->tick_hz = tp_get_u32(p + 42);
  m->max_rate_mhz = tp_get_u32(p + 46);
  m->count = p[50];
  m->stride_bytes = p[51];
  if (!tp_get_name_(p + 26, m->firmware) || m->tick_hz == 0 || m->max_rate_mhz == 0 ||
      m->count < 1 || m->count > TP_MAX_ARRAYS || m->stride_bytes < 32) {
    return TP_BAD_VALUE;
  }
  if (n < (uint16_t)(52U + (uint16_t)m->count * m->stride_bytes)) return TP_SHORT_PAYLOAD;
  for (i = 0; i < m->count; i++) {
    struct tp_array array;
    enum tp_event event = tp_get_array(p, n, i, &array);
    if (event != TP_PACKET) return event;
    for (k = 0; k < i; k++) {
      if (p[52U + (uint16_t)k * m->stride_bytes] == array.array) return TP_BAD_VALUE;
    }
  }
  return TP_PACKET;
}

static inline enum tp_event tp_get_samples(const uint8_t *p, uint16_t n, struct tp_samples *m) {
  if (n < 12) return TP_SHORT_PAYLOAD;
  m->array = p[0];
  m->taxels = p[1];
  m->temperature_cc = tp_get_i16(p + 2);
  m->sequence = tp_get_u32(p + 4);
  m->ticks = tp_get_u32(p + 8);
  if (m->taxels < 1 || m->taxels > TP_MAX_TAXELS) return TP_BAD_VALUE;
  return (n < TP_SAMPLES_BYTES((uint16_t)m->taxels)) ? TP_SHORT_PAYLOAD : TP_PACKET;
}

/** Read taxel `i` of Samples that tp_get_samples has accepted. */
static inline struct tp_taxel tp_get_taxel(const uint8_t *p, uint8_t i) {
  const uint8_t *at = p + 12U + 6U * (uint16_t)i;
  struct tp_taxel taxel;
  taxel.x = tp_get_i16(at);
  taxel.y = tp_get_i16(at + 2);
  taxel.z = tp_get_i16(at + 4);
  taxel.status = p[12U + 6U * (uint16_t)p[1] + i];
  return taxel;
}

static inline enum tp_event tp_get_status(const uint8_t *p, uint16_t n, struct tp_status *m) {
  if (n < TP_STATUS_BYTES) return TP_SHORT_PAYLOAD;
  m->uptime_ms_low = tp_get_u32(p);
  m->uptime_ms_high = tp_get_u32(p + 4);
  m->cycles = tp_get_u32(p + 8);
  m->overruns = tp_get_u32(p + 12);
  m->rx_errors = tp_get_u32(p + 16);
  m->chip_errors = tp_get_u32(p + 20);
  m->rate_mhz = tp_get_u32(p + 24);
  m->reset_cause = p[28];
  return TP_PACKET;
}

static inline enum tp_event tp_get_clock_reply(const uint8_t *p, uint16_t n,
                                               struct tp_clock_reply *m) {
  if (n < TP_CLOCK_REPLY_BYTES) return TP_SHORT_PAYLOAD;
  m->token = tp_get_u32(p);
  m->ticks_received = tp_get_u32(p + 4);
  m->ticks_sent = tp_get_u32(p + 8);
  return TP_PACKET;
}

static inline enum tp_event tp_get_log(const uint8_t *p, uint16_t n, struct tp_log *m) {
  if (n < 6) return TP_SHORT_PAYLOAD;
  m->level = p[0];
  m->size_bytes = p[1];
  m->ticks = tp_get_u32(p + 2);
  m->text = p + 6;
  return (n < TP_LOG_BYTES((uint16_t)m->size_bytes)) ? TP_SHORT_PAYLOAD : TP_PACKET;
}

static inline enum tp_event tp_get_ack(const uint8_t *p, uint16_t n, struct tp_ack *m) {
  if (n < TP_ACK_BYTES) return TP_SHORT_PAYLOAD;
  m->command = p[0];
  m->result = p[1];
  if (m->result > TP_FAILED) m->result = TP_FAILED;
  m->request = tp_get_u16(p + 2);
  return TP_PACKET;
}

static inline enum tp_event tp_get_identify(const uint8_t *p, uint16_t n, struct tp_identify *m) {
  if (n < TP_IDENTIFY_BYTES) return TP_SHORT_PAYLOAD;
  m->request = tp_get_u16(p);
  m->major = p[2];
  m->minor = p[3];
  return TP_PACKET;
}

/**
 * Read the request number of any command except Clock poll; Start, Stop and Reboot hold nothing
 * else.
 */
static inline enum tp_event tp_get_request(const uint8_t *p, uint16_t n, uint16_t *request) {
  if (n < TP_REQUEST_BYTES) return TP_SHORT_PAYLOAD;
  *request = tp_get_u16(p);
  return TP_PACKET;
}

static inline enum tp_event tp_get_set_rate(const uint8_t *p, uint16_t n, struct tp_set_rate *m) {
  if (n < TP_SET_RATE_BYTES) return TP_SHORT_PAYLOAD;
  m->request = tp_get_u16(p);
  m->rate_mhz = tp_get_u32(p + 2);
  return TP_PACKET;
}

static inline enum tp_event tp_get_set_gain(const uint8_t *p, uint16_t n, struct tp_set_gain *m) {
  if (n < TP_SET_GAIN_BYTES) return TP_SHORT_PAYLOAD;
  m->request = tp_get_u16(p);
  m->array = p[2];
  m->gain = p[3];
  m->resolution = p[4];
  m->oversampling = p[5];
  m->filter = p[6];
  return TP_PACKET;
}

static inline enum tp_event tp_get_clock_poll(const uint8_t *p, uint16_t n, uint32_t *token) {
  if (n < TP_CLOCK_POLL_BYTES) return TP_SHORT_PAYLOAD;
  *token = tp_get_u32(p);
  return TP_PACKET;
}

static inline bool tp_is_known(uint8_t type) {
  return (type >= TP_DESCRIPTOR && type <= TP_ACK) || (type >= TP_IDENTIFY && type <= TP_REBOOT);
}

/* ---- Received packets
 * ---------------------------------------------------------------------------- */

/** The first `hold` bytes of a packet, plain; the rest is checked and counted but not kept. */
struct tp_packet {
  uint8_t *bytes; /* header and payload */
  uint16_t hold;  /* size of that memory, at least TP_HEADER */
  uint16_t size;  /* bytes received, including the crc */
};

static inline const uint8_t *tp_payload(const struct tp_packet *p) { return p->bytes + TP_HEADER; }

/** Number of readable payload bytes: those received and held. */
static inline uint16_t tp_payload_size(const struct tp_packet *p) {
  uint16_t came = (uint16_t)(p->size - TP_OVERHEAD);
  uint16_t room = (uint16_t)(p->hold - TP_HEADER);
  return (came < room) ? came : room;
}

static inline uint8_t tp_packet_type(const struct tp_packet *p) { return p->bytes[0]; }

static inline uint8_t tp_packet_board(const struct tp_packet *p) { return p->bytes[1]; }

/* ---- Serial line, receiving ------------------------------------------------------------------------ */

struct tp_serial_rx {
  struct tp_packet packet;
  uint32_t crc;
  uint16_t raw;    /* bytes since the last zero */
  uint8_t code;    /* of the current block; 0 before the first */
  uint8_t left;    /* bytes of it still to be received */
  bool discarding; /* frame too long: skip to the next zero */
};

static inline void tp_serial_clear_(struct tp_serial_rx *rx) {
  rx->packet.size = 0;
  rx->crc = TP_CRC_SEED;
  rx->raw = 0;
  rx->code = rx->left = 0;
  rx->discarding = false;
}

/**
 * Reset the receiver with `hold` bytes of memory, at least TP_HEADER; further bytes are not kept.
 */
static inline void tp_serial_reset(struct tp_serial_rx *rx, uint8_t *memory, uint16_t hold) {
  rx->packet.bytes = memory;
  rx->packet.hold = hold;
  tp_serial_clear_(rx);
}

static inline void tp_serial_take_(struct tp_serial_rx *rx, uint8_t byte) {
  if (rx->packet.size < rx->packet.hold) rx->packet.bytes[rx->packet.size] = byte;
  rx->packet.size++;
  rx->crc = tp_crc_step(rx->crc, byte);
}

/**
 * Process one byte of the line. TP_PACKET: `rx->packet` is complete and correct, until the next
 * push. TP_COBS and later: something was rejected; the next frame is decoded again.
 */
static inline enum tp_event tp_serial_push(struct tp_serial_rx *rx, uint8_t byte) {
  enum tp_event event;
  if (rx->raw == 0 && rx->code == 0 && !rx->discarding) {
    tp_serial_clear_(rx); /* discard the packet returned before */
  }
  if (byte == 0) {
    if (rx->discarding) {
      event = TP_NOTHING;
    } else if (rx->raw == 0) {
      event = TP_EMPTY;
    } else if (rx->left != 0) {
      event = TP_COBS;
    } else if (rx->packet.size < TP_OVERHEAD) {
      event = TP_RUNT;
    } else if (tp_get_u16(rx->packet.bytes + 2) != rx->packet.size - TP_OVERHEAD) {
      event = TP_LENGTH;
    } else if (rx->packet.size > TP_MAX_PACKET) {
      event = TP_OVERSIZED;
    } else if (rx->crc != TP_CRC_GOOD) {
      event = TP_CRC;
    } else if (rx->packet.bytes[1] != 0) {
      event = TP_BOARD;
    } else {
      event = TP_PACKET;
    }
    rx->raw = 0; /* the packet stays readable until the next byte */
    rx->code = 0;
    rx->discarding = false;
    return event;
  }
  if (rx->discarding) return TP_NOTHING;
  if (++rx->raw > TP_MAX_FRAME) {
    rx->discarding = true;
    return TP_OVERSIZED;
  }
  if (rx->left == 0) {
    if (rx->code != 0 && rx->code != 255) tp_serial_take_(rx, 0);
    rx->code = byte;
    rx->left = (uint8_t)(byte - 1);
  } else {
    rx->left--;
    tp_serial_take_(rx, byte);
  }
  return TP_NOTHING;
}

/* ---- CAN 2.0B and CAN FD ------------------------------------------------------------------------------ */

#ifndef TP_CAN_BYTES
#define TP_CAN_BYTES 64 /* 8: for controllers without CAN FD, to save memory */
#endif

#define TP_CAN_MARK 0x2A5UL
#define TP_CAN_START 0x80
#define TP_CAN_END 0x40
#define TP_CAN_TOGGLE 0x20
#define TP_CAN_ID 0x1F
#define TP_CAN_PADDING 15 /* most padding bytes of a CAN FD frame */

/** A data frame with a 29-bit identifier. */
struct tp_can_frame {
  uint32_t identifier;
  uint8_t size;
  bool fd;
  uint8_t data[TP_CAN_BYTES];
};

static inline uint32_t tp_can_identifier(uint8_t type, uint8_t board) {
  uint32_t priority = 2;
  if (type == TP_CLOCK_POLL || type == TP_CLOCK_REPLY) priority = 1;
  if (type == TP_SAMPLES) priority = 3;
  if (type == TP_STATUS) priority = 5;
  if (type == TP_LOG) priority = 6;
  return priority << 26 | TP_CAN_MARK << 16 | (uint32_t)type << 8 | board;
}

/** Whether the identifier has the mark of this protocol; other frames belong to others. */
static inline bool tp_can_is_ours(uint32_t identifier) {
  return (identifier >> 16 & 0x3FFUL) == TP_CAN_MARK && (identifier & 0x80UL) == 0 &&
         identifier >> 29 == 0;
}

/** Number of frames for a packet of `size` bytes. */
static inline uint16_t tp_can_frames(uint16_t size, bool fd) {
  uint16_t step = fd ? 63 : 7;
  return (uint16_t)((size + step - 1) / step);
}

/**
 * Make frame number `k` (from 0) of the transfer of a plain packet. `transfer`: 0 to 31,
 * incremented for each transfer of the same type to or from the same board.
 */
static inline void tp_can_segment(const uint8_t *packet, uint16_t size, uint16_t k, bool fd,
                                  uint8_t transfer, struct tp_can_frame *frame) {
  uint8_t step = (uint8_t)((fd && TP_CAN_BYTES == 64) ? 63 : 7);
  uint16_t from = (uint16_t)(k * step);
  uint8_t part = (uint8_t)((size - from < step) ? size - from : step);
  uint8_t tail = (uint8_t)((transfer & TP_CAN_ID) | ((k & 1U) ? 0 : TP_CAN_TOGGLE));
  uint8_t i;
  frame->identifier = tp_can_identifier(packet[0], packet[1]);
  frame->fd = step == 63;
  for (i = 0; i < part; i++) frame->data[i] = packet[from + i];
  if (k == 0) tail |= TP_CAN_START;
  if (from + part == size) {
    tail |= TP_CAN_END;
    if (frame->fd) { /* pad to the next CAN FD length: 8, 12, 16, 20, 24, 32, 48, 64 */
      uint8_t full = (uint8_t)((part < 24) ? (part + 4) / 4 * 4 : (part < 32) ? 32 : (part < 48) ? 48 : 64);
      if (part < 8) full = (uint8_t)(part + 1);
      while (part < full - 1) frame->data[part++] = 0;
    }
  }
  frame->data[part] = tail;
  frame->size = (uint8_t)(part + 1);
}

/** Received part of one transfer of one type from or to one board. */
struct tp_can_slot {
  struct tp_packet packet;
  uint32_t crc;
  uint16_t key;  /* type and board of the identifier */
  uint16_t age;  /* when it was last used */
  bool used;
  bool open;     /* a transfer is in progress */
  bool fd;
  uint8_t expected; /* tail of the next frame without its end bit */
  uint8_t last_size;
  uint8_t last[TP_CAN_BYTES]; /* previous frame, to detect a repetition */
};

struct tp_can_rx {
  struct tp_can_slot *slots;
  uint8_t count;
  uint16_t clock;
  uint32_t interrupted;    /* unfinished transfers dropped for a new start or to free their slot */
  struct tp_packet packet; /* after TP_PACKET: the packet, until the next push */
  uint8_t unknown_type;    /* after TP_UNKNOWN_TYPE */
  uint16_t unknown_request;
};

/**
 * Reset the receiver with `count` slots and `hold` bytes of memory for each (`count` * `hold` in
 * all). A slot serves one type of one board at a time. When all are taken, the least recently used
 * one is reused and its unfinished transfer dropped.
 */
static inline void tp_can_reset(struct tp_can_rx *rx, struct tp_can_slot *slots, uint8_t count,
                                uint8_t *memory, uint16_t hold) {
  uint8_t i;
  rx->slots = slots;
  rx->count = count;
  rx->clock = 0;
  rx->interrupted = 0;
  rx->unknown_type = 0;
  rx->unknown_request = 0;
  rx->packet.bytes = memory;
  rx->packet.hold = hold;
  rx->packet.size = 0;
  for (i = 0; i < count; i++) {
    slots[i].packet.bytes = memory + (size_t)i * hold;
    slots[i].packet.hold = hold;
    slots[i].packet.size = 0;
    slots[i].used = slots[i].open = false;
    slots[i].last_size = 0;
    slots[i].age = 0;
  }
}

/**
 * Slot of `key`. NULL if there is none: a frame that is not a start does not displace another slot.
 */
static inline struct tp_can_slot *tp_can_slot_(struct tp_can_rx *rx, uint16_t key, bool start) {
  struct tp_can_slot *oldest = rx->slots;
  uint8_t i;
  rx->clock++;
  for (i = 0; i < rx->count; i++) {
    struct tp_can_slot *slot = &rx->slots[i];
    if (slot->used && slot->key == key) {
      slot->age = rx->clock;
      return slot;
    }
    if (oldest->used &&
        (!slot->used || (uint16_t)(rx->clock - slot->age) > (uint16_t)(rx->clock - oldest->age))) {
      oldest = slot;
    }
  }
  if (oldest->used && !start) return NULL;
  if (oldest->used && oldest->open) rx->interrupted++;
  oldest->used = true;
  oldest->open = false;
  oldest->key = key;
  oldest->age = rx->clock;
  oldest->last_size = 0;
  return oldest;
}

static inline enum tp_event tp_can_whole_(struct tp_can_rx *rx, struct tp_can_slot *slot) {
  struct tp_packet *p = &slot->packet;
  uint32_t size;
  if (p->size < TP_OVERHEAD) return TP_RUNT;
  size = TP_OVERHEAD + (uint32_t)tp_get_u16(p->bytes + 2);
  if (p->size < size || p->size - size > (slot->fd ? TP_CAN_PADDING : 0)) return TP_LENGTH;
  if (size > TP_MAX_PACKET) return TP_OVERSIZED;
  if (slot->crc != TP_CRC_GOOD) return TP_CRC;
  if (p->bytes[0] != slot->key >> 8) return TP_TYPE_MISMATCH;
  if (p->bytes[1] != (slot->key & 0x7F)) return TP_BOARD;
  rx->packet = *p;
  rx->packet.size = (uint16_t)size;
  return TP_PACKET;
}

static inline void tp_can_take_(struct tp_can_slot *slot, uint8_t byte) {
  struct tp_packet *p = &slot->packet;
  uint16_t at = p->size++;
  if (at < p->hold) p->bytes[at] = byte;
  /* Padding of CAN FD is not part of the packet, whose length field tells where it ends. */
  if (at < TP_HEADER || at - TP_OVERHEAD < (int32_t)tp_get_u16(p->bytes + 2)) {
    slot->crc = tp_crc_step(slot->crc, byte);
  }
}

/**
 * Process one frame of the bus. TP_PACKET: `rx->packet` is complete and correct, until the next
 * push. TP_UNKNOWN_TYPE: once per such transfer; a board answers `unknown_request` with a refusal.
 */
static inline enum tp_event tp_can_push(struct tp_can_rx *rx, const struct tp_can_frame *frame) {
  uint8_t full = (uint8_t)(frame->fd ? 64 : 8);
  uint8_t type = (uint8_t)(frame->identifier >> 8 & 0xFFUL);
  struct tp_can_slot *slot;
  uint8_t tail;
  uint8_t i;
  bool same;
  if (!tp_can_is_ours(frame->identifier)) return TP_FOREIGN;
  if (frame->size == 0 || frame->size > TP_CAN_BYTES) return TP_BAD_FRAME;
  tail = frame->data[frame->size - 1];
  if (!tp_is_known(type)) {
    if ((tail & TP_CAN_START) == 0) return TP_NOTHING;
    rx->unknown_type = type;
    rx->unknown_request = (frame->size > 6) ? tp_get_u16(frame->data + 4) : 0;
    return TP_UNKNOWN_TYPE;
  }
  slot = tp_can_slot_(rx, (uint16_t)(frame->identifier & 0xFFFFUL),
                      (tail & TP_CAN_START) != 0);
  if (slot == NULL) return TP_NO_START;
  same = slot->last_size == frame->size;
  for (i = 0; same && i < frame->size; i++) same = slot->last[i] == frame->data[i];
  if (same) return TP_DUPLICATE;
  slot->last_size = frame->size;
  for (i = 0; i < frame->size; i++) slot->last[i] = frame->data[i];
  if (frame->size > full || (frame->size < full && (tail & TP_CAN_END) == 0)) {
    slot->open = false;
    return TP_BAD_FRAME;
  }
  if (tail & TP_CAN_START) {
    if (slot->open) rx->interrupted++;
    slot->open = false;
    if ((tail & TP_CAN_TOGGLE) == 0) return TP_OUT_OF_ORDER;
    slot->open = true;
    slot->fd = frame->fd;
    slot->crc = TP_CRC_SEED;
    slot->packet.size = 0;
  } else if (!slot->open) {
    return TP_NO_START;
  } else if ((tail & (uint8_t)~TP_CAN_END) != slot->expected || frame->fd != slot->fd) {
    slot->open = false;
    return TP_OUT_OF_ORDER;
  }
  if (slot->packet.size + frame->size - 1 > TP_MAX_PACKET + TP_CAN_PADDING) {
    slot->open = false;
    return TP_OVERSIZED;
  }
  for (i = 0; i + 1 < frame->size; i++) tp_can_take_(slot, frame->data[i]);
  if ((tail & TP_CAN_END) == 0) {
    slot->expected = (uint8_t)((tail ^ TP_CAN_TOGGLE) & (uint8_t)~TP_CAN_START);
    return TP_NOTHING;
  }
  slot->open = false;
  return tp_can_whole_(rx, slot);
}

#endif
