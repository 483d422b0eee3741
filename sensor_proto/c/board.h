/* SPDX-License-Identifier: Apache-2.0 */
/**
 * A complete taxel board on a handful of port functions: PROTOCOL.md section 5 in C99.
 *
 * The author of a board describes it (`struct board_config`), writes the functions of `struct
 * board_port` for the microcontroller, and calls
 *
 *     if (board_begin(&board, &config, &port, TP_POWER_ON))
 *       for (;;) board_poll(&board);
 *
 * `board_poll` never waits: it reads what the host sent, samples when a cycle is due, and writes
 * what the line has room for. Call it at least ten times per sampling period. Every loss is
 * counted: cycles that could not be sent or were not started in time are overruns in the status
 * message, rejected frames are rx_errors.
 *
 * Include it in one source file, after defining what should differ from the defaults:
 *
 *     BOARD_MAX_ARRAYS    arrays of the board (1)
 *     BOARD_MAX_TAXELS    taxels of all its arrays together (16)
 *     BOARD_ARRAY_TAXELS  taxels of its largest array (BOARD_MAX_TAXELS)
 *     BOARD_CYCLES        sampling cycles held, including the one being filled; 3 or more (4)
 *     BOARD_LOG_TEXT      bytes of a log line, 1 to 255 (32)
 *     BOARD_REPLIES       queued acks, and as many queued clock replies: 2, 4, 8 … (4)
 *     BOARD_CAN           1: on a CAN bus; 0: on a serial line (0)
 *     BOARD_CAN_SLOTS     commands that may arrive interleaved, CAN only (4)
 *
 * `tactile board-check` tests a board against the protocol.
 */
#ifndef TACTILE_BOARD_H
#define TACTILE_BOARD_H

#ifndef BOARD_CAN
#define BOARD_CAN 0
#endif

#include "tactile_proto.h"

#ifndef BOARD_MAX_ARRAYS
#define BOARD_MAX_ARRAYS 1
#endif
#ifndef BOARD_MAX_TAXELS
#define BOARD_MAX_TAXELS 16
#endif
#ifndef BOARD_ARRAY_TAXELS
#define BOARD_ARRAY_TAXELS BOARD_MAX_TAXELS
#endif
#ifndef BOARD_CYCLES
#define BOARD_CYCLES 4
#endif
#ifndef BOARD_LOG_TEXT
#define BOARD_LOG_TEXT 32
#endif
#ifndef BOARD_REPLIES
#define BOARD_REPLIES 4
#endif
#ifndef BOARD_CAN_SLOTS
#define BOARD_CAN_SLOTS 4
#endif

#if BOARD_MAX_ARRAYS < 1 || BOARD_MAX_ARRAYS > TP_MAX_ARRAYS
#error "BOARD_MAX_ARRAYS: 1 to 16"
#endif
#if BOARD_ARRAY_TAXELS < 1 || BOARD_ARRAY_TAXELS > TP_MAX_TAXELS
#error "BOARD_ARRAY_TAXELS: 1 to 128; set it where BOARD_MAX_TAXELS, of all arrays, is more"
#endif
#if BOARD_CYCLES < 3 || BOARD_CYCLES > 100
#error "BOARD_CYCLES: 3 to 100"
#endif
#if BOARD_REPLIES < 1 || BOARD_REPLIES > 64 || (BOARD_REPLIES & (BOARD_REPLIES - 1)) != 0
#error "BOARD_REPLIES: 1, 2, 4 ... 64"
#endif
#if BOARD_LOG_TEXT < 1 || BOARD_LOG_TEXT > TP_MAX_TEXT
#error "BOARD_LOG_TEXT: 1 to 255"
#endif

#define BOARD_ALL_ARRAYS 255

/* Longest payload that this board sends. */
#define BOARD_MORE_(a, b) ((a) > (b) ? (a) : (b))
#define BOARD_PAYLOAD                                        \
  BOARD_MORE_(TP_DESCRIPTOR_BYTES(BOARD_MAX_ARRAYS),         \
              BOARD_MORE_(TP_SAMPLES_BYTES(BOARD_ARRAY_TAXELS), TP_LOG_BYTES(BOARD_LOG_TEXT)))
#define BOARD_HOLD 12 /* bytes of a command that are read: header, and 7 of Set gain */

/** One array of `rows` times `columns` taxels. Scales are those after a reset. */
struct board_array {
  const char *name; /* at most 15 printable ASCII characters */
  uint8_t chip;     /* 1 MLX90393, 0 any other */
  uint8_t rows;
  uint8_t columns;
  uint32_t pitch_um;
  uint32_t lsb_xy_nt;
  uint32_t lsb_z_nt;
};

/** Description of the board. Arrays are numbered from 0 in this order. */
struct board_config {
  const uint8_t *unique_id; /* 8 bytes, different on every board made */
  const char *model;
  const char *firmware;
  const struct board_array *arrays;
  uint8_t count;            /* number of arrays */
  uint32_t tick_hz;         /* clock rate: 10 kHz to 2 MHz */
  uint32_t max_rate_mhz;    /* after a reset */
  uint32_t default_rate_mhz;
#if BOARD_CAN
  uint8_t node; /* 0 to 126 */
  bool fd;      /* CAN FD */
#endif
};

/**
 * Functions that the microcontroller provides; each call gets `self`. Those marked optional may be
 * NULL. None may wait longer than a sampling period allows.
 */
struct board_port {
  void *self;

#if BOARD_CAN
  /** Pass a frame to the controller; false if no mailbox is free. */
  bool (*send)(void *self, const struct tp_can_frame *frame);
  /** Next received frame; false if there is none. */
  bool (*receive)(void *self, struct tp_can_frame *frame);
#else
  /** Write as many bytes as fit now and return how many; 0 if the line takes none. */
  size_t (*write)(void *self, const uint8_t *bytes, size_t count);
  /** Read received bytes, at most `count`, and return how many. */
  size_t (*read)(void *self, uint8_t *bytes, size_t count);
#endif

  /** Free-running clock at `tick_hz`, all 32 bits; it must never run backwards. */
  uint32_t (*ticks)(void *self);

  /**
   * Read array `array`: a value for each of its taxels, and the mean temperature of its chips in
   * hundredths of a degree C. False: the conversion is not finished, ask again. Axes: section 4.
   */
  bool (*sample)(void *self, uint8_t array, struct tp_taxel *taxels, int16_t *temperature_cc);

  /**
   * Optional: start a conversion on all chips now, for `sample` to read. If NULL, `sample` converts
   * by itself, and each array has its own sampling instant.
   */
  void (*convert)(void *self);

  /**
   * Optional: carry out Set gain for array `array` (BOARD_ALL_ARRAYS: all) at the current rate
   * `rate_mhz`. Returns TP_OK, or the reason for refusal with nothing changed. If NULL, the board
   * refuses every Set gain with TP_BAD_ARGUMENT.
   */
  enum tp_answer (*set_gain)(void *self, uint8_t array, const struct tp_set_gain *codes,
                             uint32_t rate_mhz);

  /**
   * Needed with `set_gain`: the current scales of array `array`. Returns the highest sample rate of
   * the board in mHz.
   */
  uint32_t (*scales)(void *self, uint8_t array, uint32_t *lsb_xy_nt, uint32_t *lsb_z_nt);

  /** Reset the microcontroller. If it returns, it must have called `board_begin` again. */
  void (*reboot)(void *self);
};

/* Contents of the transmit buffer, in sending order. */
enum board_item_ {
  BOARD_NONE_,
  BOARD_CLOCK_,
  BOARD_ACK_,
  BOARD_DESCRIPTOR_,
  BOARD_STATUS_,
  BOARD_LOG_,
  BOARD_SAMPLES_
};

struct board_cycle_ {
  uint32_t sequence;
  uint32_t ticks[BOARD_MAX_ARRAYS];
  int16_t temperature_cc[BOARD_MAX_ARRAYS];
  struct tp_taxel taxels[BOARD_MAX_TAXELS];
};

struct board_poll_ {
  uint32_t token;
  uint32_t ticks;
};

/* Bytes come first, where a Cortex-M0 reaches them in one instruction. Names ending in _ are
 * private. */
struct board {
  bool streaming;
  uint8_t logs_lost; /* lines dropped because one was waiting; reported in the next line */

  uint8_t cause_;
  bool rebooting_; /* the ack of Reboot is queued or sent */
  bool reboot_sent_;
  bool status_due_;
  bool converting_;
  bool greeted_;        /* the initial zero was sent */
  uint8_t descriptors_; /* Identifies to answer */
  uint8_t acks_;        /* queued, from first_ack_ on */
  uint8_t first_ack_;
  uint8_t polls_;
  uint8_t first_poll_;
  uint8_t log_size_;
  uint8_t log_level_;
  uint8_t waiting_;    /* whole cycles from order_[0] on, oldest first; then the one being filled */
  uint8_t next_array_; /* next array of the oldest cycle to be sent */
  uint8_t reading_;    /* next array of the newest cycle to be read */
  uint8_t item_;       /* what is in tx_ */
  uint8_t order_[BOARD_CYCLES];
  uint16_t tx_size_;
  uint16_t tx_at_; /* bytes (on CAN: frames) already sent */

  const struct board_config *config;
  const struct board_port *port;
  uint32_t cycles;
  uint32_t overruns;
  uint32_t rx_errors;
  uint32_t chip_errors;
  uint32_t rate_mhz;

  uint32_t sequence_;
  uint32_t due_;    /* ticks at which the next conversion starts */
  uint32_t period_; /* in ticks, with the remainder of their division by the rate */
  uint32_t period_rest_;
  uint32_t rest_;
  uint32_t second_; /* ticks at which the current second of uptime began */
  uint32_t uptime_s_;
  uint32_t reboot_from_;
  uint32_t log_ticks_;

#if BOARD_CAN
  struct tp_can_rx rx_;
  uint32_t interrupted_;
  struct tp_can_slot slots_[BOARD_CAN_SLOTS];
  uint8_t held_[BOARD_CAN_SLOTS * BOARD_HOLD];
  uint8_t transfer_[6];
  uint8_t tx_[TP_PACKET_BYTES(BOARD_PAYLOAD)];
#else
  struct tp_serial_rx rx_;
  uint8_t held_[BOARD_HOLD];
  uint8_t tx_[TP_SERIAL_BYTES(BOARD_PAYLOAD)];
#endif
  struct tp_ack ack_[BOARD_REPLIES];
  struct board_poll_ poll_[BOARD_REPLIES];
  uint8_t log_[BOARD_LOG_TEXT];
  struct board_cycle_ cycle_[BOARD_CYCLES];
};

/* Computes 1000 * a in two halves, and its division by c (result below 2^32) with remainder.
 * Written out so that no 64-bit multiplication or division is linked. */
static inline void board_thousand_(uint32_t a, uint32_t *high, uint32_t *low) {
  uint32_t lower = (a & 0xFFFFUL) * 1000U;
  uint32_t upper = (a >> 16) * 1000U + (lower >> 16);
  *low = upper << 16 | (lower & 0xFFFFUL);
  *high = upper >> 16;
}

static inline uint32_t board_ratio_(uint32_t a, uint32_t c, uint32_t *rest) {
  uint32_t high;
  uint32_t low;
  uint8_t i;
  board_thousand_(a, &high, &low);
  for (i = 0; i < 32; i++) {
    bool carry = (high >> 31) != 0;
    high = high << 1 | low >> 31;
    low <<= 1;
    if (carry || high >= c) {
      high -= c;
      low |= 1;
    }
  }
  *rest = high;
  return low;
}

static inline uint8_t board_taxels_(const struct board *b, uint8_t array) {
  return (uint8_t)(b->config->arrays[array].rows * b->config->arrays[array].columns);
}

static inline uint16_t board_first_taxel_(const struct board *b, uint8_t array) {
  uint16_t first = 0;
  uint8_t i;
  for (i = 0; i < array; i++) first = (uint16_t)(first + board_taxels_(b, i));
  return first;
}

static inline uint32_t board_max_rate_(const struct board *b) {
  uint32_t xy;
  uint32_t z;
  return b->port->scales ? b->port->scales(b->port->self, 0, &xy, &z) : b->config->max_rate_mhz;
}

/** Discard the queued samples, which are counted, and the conversion in progress. */
static inline void board_drop_all_(struct board *b) {
  b->overruns += b->waiting_;
  b->waiting_ = 0;
  b->next_array_ = 0;
  b->converting_ = false;
  if (b->item_ == BOARD_SAMPLES_ && b->tx_at_ == 0) b->item_ = BOARD_NONE_;
}

static inline void board_start_over_(struct board *b) {
  b->due_ = b->port->ticks(b->port->self);
  b->rest_ = 0;
}

static inline void board_take_rate_(struct board *b, uint32_t rate_mhz) {
  b->rate_mhz = rate_mhz;
  b->period_ = board_ratio_(b->config->tick_hz, rate_mhz, &b->period_rest_);
}

/**
 * Start as after a reset with cause `cause` (`enum tp_reset_cause`). config, port and what they
 * point to must stay valid. The chips must have the settings of `config`. False: the arrays exceed
 * BOARD_MAX_ARRAYS, BOARD_MAX_TAXELS or BOARD_ARRAY_TAXELS, or a number in `config` is out of
 * range; the board must then not be polled.
 */
static inline bool board_begin(struct board *b, const struct board_config *config,
                               const struct board_port *port, uint8_t cause) {
  uint16_t taxels = 0;
  uint8_t i;
  b->config = config;
  b->port = port;
  b->cycles = b->overruns = b->rx_errors = b->chip_errors = 0;
  b->streaming = false;
  b->logs_lost = 0;
  b->cause_ = cause;
  b->rebooting_ = b->reboot_sent_ = b->status_due_ = b->converting_ = b->greeted_ = false;
  b->descriptors_ = b->acks_ = b->polls_ = b->log_size_ = 0;
  b->first_ack_ = b->first_poll_ = 0;
  b->waiting_ = b->next_array_ = b->reading_ = 0;
  for (i = 0; i < BOARD_CYCLES; i++) b->order_[i] = i;
  b->item_ = BOARD_NONE_;
  b->tx_size_ = b->tx_at_ = 0;
  b->sequence_ = 0;
  b->uptime_s_ = 0;
  b->second_ = port->ticks(port->self);
  b->rate_mhz = 0;
  if (config->default_rate_mhz != 0) board_take_rate_(b, config->default_rate_mhz);
#if BOARD_CAN
  tp_can_reset(&b->rx_, b->slots_, BOARD_CAN_SLOTS, b->held_, BOARD_HOLD);
  for (i = 0; i < 6; i++) b->transfer_[i] = 0;
  b->interrupted_ = 0;
#else
  tp_serial_reset(&b->rx_, b->held_, BOARD_HOLD);
#endif
  if (config->count < 1 || config->count > BOARD_MAX_ARRAYS || config->tick_hz < 10000 ||
      config->tick_hz > 2000000 || config->default_rate_mhz == 0 ||
      config->default_rate_mhz > board_max_rate_(b)) {
    return false;
  }
  for (i = 0; i < config->count; i++) {
    uint16_t n = (uint16_t)((uint16_t)config->arrays[i].rows * config->arrays[i].columns);
    if (n < 1 || n > BOARD_ARRAY_TAXELS) return false;
    taxels = (uint16_t)(taxels + n);
  }
  return taxels <= BOARD_MAX_TAXELS;
}

/**
 * Queue a line of UTF-8 text for the host; `level`: `enum tp_level`. Only one line can wait: a
 * further one is dropped and counted in `logs_lost`. A long line is cut between characters; control
 * characters become '?'.
 */
static inline void board_log(struct board *b, uint8_t level, const char *text) {
  uint8_t n = 0;
  if (b->log_size_ != 0) {
    if (b->logs_lost < 255) b->logs_lost++;
    return;
  }
  while (n < BOARD_LOG_TEXT && text[n] != '\0') {
    uint8_t c = (uint8_t)text[n];
    b->log_[n++] = (uint8_t)((c < 0x20 || c == 0x7F) ? '?' : c);
  }
  if (text[n] != '\0') {
    while (n > 0 && ((uint8_t)text[n] & 0xC0U) == 0x80U) n--;
  }
  b->log_size_ = n;
  b->log_level_ = level;
  b->log_ticks_ = b->port->ticks(b->port->self);
}

/* ---- Commands from the host
 * ---------------------------------------------------------------------- */

static inline void board_answer_(struct board *b, uint8_t command, uint16_t request,
                                 enum tp_answer result) {
  struct tp_ack *ack = &b->ack_[(b->first_ack_ + b->acks_++) & (BOARD_REPLIES - 1)];
  ack->command = command;
  ack->request = request;
  ack->result = (uint8_t)result;
}

static inline enum tp_answer board_set_gain_(struct board *b, const struct tp_set_gain *codes) {
  const struct board_port *port = b->port;
  enum tp_answer result;
  if ((codes->array >= b->config->count && codes->array != BOARD_ALL_ARRAYS) || !port->set_gain) {
    return TP_BAD_ARGUMENT;
  }
  result = port->set_gain(port->self, codes->array, codes, b->rate_mhz);
  if (result == TP_OK) {
    board_drop_all_(b);
    board_start_over_(b);
  }
  return result;
}

/** Carry out a command of type `type`; false if it was rejected without an answer. */
static inline bool board_obey_(struct board *b, uint8_t type, const uint8_t *p, uint16_t n,
                               uint32_t now) {
  enum tp_answer result = TP_OK;
  struct board_poll_ *poll;
  uint16_t request;
  if ((type & 0x80) == 0) return false; /* messages of boards, echoed by the line */
  if (type == TP_IDENTIFY) {
    if (n < TP_IDENTIFY_BYTES || b->descriptors_ == 255) return false;
    b->descriptors_++;
    return true;
  }
  if (type == TP_CLOCK_POLL) {
    if (n < TP_CLOCK_POLL_BYTES || b->polls_ == BOARD_REPLIES) return false;
    poll = &b->poll_[(b->first_poll_ + b->polls_++) & (BOARD_REPLIES - 1)];
    poll->token = tp_get_u32(p);
    poll->ticks = now;
    return true;
  }
  if (b->acks_ == BOARD_REPLIES || tp_get_request(p, n, &request) != TP_PACKET) return false;
  if (b->rebooting_) {
    board_answer_(b, type, request, TP_BUSY);
    return true;
  }
  switch (type) {
    case TP_START:
      if (!b->streaming) board_start_over_(b);
      b->streaming = true;
      break;
    case TP_STOP:
      b->streaming = false;
      b->converting_ = false;
      break;
    case TP_SET_RATE: {
      struct tp_set_rate m;
      if (tp_get_set_rate(p, n, &m) != TP_PACKET) return false;
      if (m.rate_mhz == 0 || m.rate_mhz > board_max_rate_(b)) {
        result = TP_BAD_ARGUMENT;
      } else {
        board_drop_all_(b);
        board_take_rate_(b, m.rate_mhz);
        board_start_over_(b);
      }
      break;
    }
    case TP_SET_GAIN: {
      struct tp_set_gain m;
      if (tp_get_set_gain(p, n, &m) != TP_PACKET) return false;
      result = board_set_gain_(b, &m);
      break;
    }
    case TP_REBOOT:
      b->rebooting_ = true;
      break;
    default:
      b->rx_errors++; /* counted, as is every type of a newer version */
      result = TP_UNKNOWN_COMMAND;
  }
  board_answer_(b, type, request, result);
  return true;
}

static inline void board_handle_(struct board *b, const struct tp_packet *packet) {
  uint32_t now = b->port->ticks(b->port->self);
  if (!board_obey_(b, tp_packet_type(packet), tp_payload(packet), tp_payload_size(packet), now)) {
    b->rx_errors++;
  }
}

#if BOARD_CAN
static inline void board_receive_(struct board *b) {
  struct tp_can_frame frame;
  uint8_t i;
  for (i = 0; i < 16 && b->port->receive(b->port->self, &frame); i++) {
    uint8_t node = (uint8_t)(frame.identifier & 0x7FUL);
    enum tp_event event;
    if (!tp_can_is_ours(frame.identifier) || (node != b->config->node && node != TP_BROADCAST)) {
      continue; /* for another node or protocol */
    }
    event = tp_can_push(&b->rx_, &frame);
    if (event == TP_PACKET) {
      board_handle_(b, &b->rx_.packet);
    } else if (event != TP_NOTHING) {
      b->rx_errors++;
      if (event == TP_UNKNOWN_TYPE && (b->rx_.unknown_type & 0x80) && b->acks_ < BOARD_REPLIES) {
        board_answer_(b, b->rx_.unknown_type, b->rx_.unknown_request, TP_UNKNOWN_COMMAND);
      }
    }
    b->rx_errors += b->rx_.interrupted - b->interrupted_;
    b->interrupted_ = b->rx_.interrupted;
  }
}
#else
static inline void board_receive_(struct board *b) {
  uint8_t bytes[16];
  uint8_t round;
  for (round = 0; round < 4; round++) {
    size_t n = b->port->read(b->port->self, bytes, sizeof bytes);
    size_t i;
    for (i = 0; i < n; i++) {
      enum tp_event event = tp_serial_push(&b->rx_, bytes[i]);
      if (event == TP_PACKET) {
        board_handle_(b, &b->rx_.packet);
      } else if (event != TP_NOTHING && event != TP_EMPTY) {
        b->rx_errors++;
      }
    }
    if (n < sizeof bytes) break;
  }
}
#endif

/* ---- Sampling -------------------------------------------------------------------------------------- */

/** Remove queued cycle number `i`; its buffer goes to the end of the order. */
static inline void board_remove_(struct board *b, uint8_t i) {
  for (; i + 1 < BOARD_CYCLES; i++) {
    uint8_t place = b->order_[i];
    b->order_[i] = b->order_[i + 1];
    b->order_[i + 1] = place;
  }
  b->waiting_--;
}

/** Make room for the cycle that begins: drop the oldest one of which nothing has been sent. */
static inline void board_make_room_(struct board *b) {
  if (b->waiting_ < BOARD_CYCLES - 1) return;
  if (b->next_array_ == 0 && b->tx_at_ == 0 && b->item_ == BOARD_SAMPLES_) b->item_ = BOARD_NONE_;
  board_remove_(b, (uint8_t)(b->next_array_ != 0));
  b->overruns++;
}

/** Set `due_` to the start of the cycle after it. */
static inline void board_step_(struct board *b) {
  b->due_ += b->period_;
  b->rest_ += b->period_rest_;
  if (b->rest_ >= b->rate_mhz) {
    b->rest_ -= b->rate_mhz;
    b->due_++;
  }
}

static inline void board_sample_(struct board *b) {
  const struct board_port *port = b->port;
  struct board_cycle_ *cycle;
  uint8_t i;
  if (!b->streaming) return;
  if (!b->converting_) {
    uint32_t now = port->ticks(port->self);
    if ((int32_t)(now - b->due_) < 0) return;
    board_step_(b);
    /* Late by whole periods: those cycles were never started but count as missing. */
    for (i = 0; i < 100 && (int32_t)(now - b->due_) >= 0; i++) {
      board_step_(b);
      b->sequence_++;
      b->cycles++;
      b->overruns++;
    }
    board_make_room_(b);
    cycle = &b->cycle_[b->order_[b->waiting_]];
    if (port->convert) {
      now = port->ticks(port->self);
      port->convert(port->self);
    }
    for (i = 0; i < b->config->count; i++) cycle->ticks[i] = now;
    b->converting_ = true;
    b->reading_ = 0;
  }
  cycle = &b->cycle_[b->order_[b->waiting_]];
  while (b->reading_ < b->config->count) {
    uint8_t n = board_taxels_(b, b->reading_);
    struct tp_taxel *taxels = cycle->taxels + board_first_taxel_(b, b->reading_);
    if (!port->convert) cycle->ticks[b->reading_] = port->ticks(port->self);
    if (!port->sample(port->self, b->reading_, taxels, &cycle->temperature_cc[b->reading_])) return;
    for (i = 0; i < n; i++) {
      if (taxels[i].status & TP_READ_FAILED) b->chip_errors++;
    }
    b->reading_++;
  }
  b->converting_ = false;
  cycle->sequence = b->sequence_++;
  b->cycles++;
  b->waiting_++;
}

/* ---- Messages to the host
 * ------------------------------------------------------------------------ */

static inline void board_open_(struct board *b, struct tp_writer *w, uint8_t type,
                               uint16_t length) {
#if BOARD_CAN
  tp_begin(w, b->tx_, sizeof b->tx_, type, b->config->node, length, false);
#else
  tp_begin(w, b->tx_, sizeof b->tx_, type, 0, length, true);
#endif
}

static inline void board_write_descriptor_(struct board *b, struct tp_writer *w) {
  const struct board_config *c = b->config;
  uint8_t i;
  uint8_t k;
  board_open_(b, w, TP_DESCRIPTOR, (uint16_t)TP_DESCRIPTOR_BYTES((uint16_t)c->count));
  tp_u8(w, TP_MAJOR);
  tp_u8(w, TP_MINOR);
  tp_bytes(w, c->unique_id, 8);
  tp_name(w, c->model);
  tp_name(w, c->firmware);
  tp_u32(w, c->tick_hz);
  tp_u32(w, board_max_rate_(b));
  tp_u8(w, c->count);
  tp_u8(w, 32);
  for (i = 0; i < c->count; i++) {
    const struct board_array *a = &c->arrays[i];
    uint32_t lsb[2];
    lsb[0] = a->lsb_xy_nt;
    lsb[1] = a->lsb_z_nt;
    if (b->port->scales) (void)b->port->scales(b->port->self, i, &lsb[0], &lsb[1]);
    tp_u8(w, i);
    tp_u8(w, a->chip);
    tp_u8(w, a->rows);
    tp_u8(w, a->columns);
    tp_u32(w, a->pitch_um);
    for (k = 0; k < 2; k++) tp_u32(w, lsb[k]);
    tp_name(w, a->name);
  }
}

static inline void board_write_status_(struct board *b, struct tp_writer *w, uint32_t now) {
  uint32_t ms;
  uint32_t low;
  uint32_t high;
  uint32_t rest;
  board_thousand_(b->uptime_s_, &high, &low);
  ms = board_ratio_(now - b->second_, b->config->tick_hz, &rest);
  low += ms;
  if (low < ms) high++;
  board_open_(b, w, TP_STATUS, TP_STATUS_BYTES);
  tp_u32(w, low);
  tp_u32(w, high);
  tp_u32(w, b->cycles);
  tp_u32(w, b->overruns);
  tp_u32(w, b->rx_errors);
  tp_u32(w, b->chip_errors);
  tp_u32(w, b->streaming ? b->rate_mhz : 0);
  tp_u8(w, b->cause_);
}

static inline void board_write_samples_(struct board *b, struct tp_writer *w) {
  const struct board_cycle_ *cycle = &b->cycle_[b->order_[0]];
  const struct tp_taxel *taxels = cycle->taxels + board_first_taxel_(b, b->next_array_);
  uint8_t n = board_taxels_(b, b->next_array_);
  uint8_t i;
  board_open_(b, w, TP_SAMPLES, (uint16_t)TP_SAMPLES_BYTES((uint16_t)n));
  tp_u8(w, b->next_array_);
  tp_u8(w, n);
  tp_u16(w, (uint16_t)cycle->temperature_cc[b->next_array_]);
  tp_u32(w, cycle->sequence);
  tp_u32(w, cycle->ticks[b->next_array_]);
  for (i = 0; i < n; i++) {
    tp_u16(w, (uint16_t)taxels[i].x);
    tp_u16(w, (uint16_t)taxels[i].y);
    tp_u16(w, (uint16_t)taxels[i].z);
  }
  for (i = 0; i < n; i++) tp_u8(w, taxels[i].status);
}

/** Write the next message into the transmit buffer; false if there is none. */
static inline bool board_compose_(struct board *b) {
  uint32_t now = b->port->ticks(b->port->self);
  struct tp_writer w;
  if (b->polls_ != 0) {
    b->item_ = BOARD_CLOCK_;
    board_open_(b, &w, TP_CLOCK_REPLY, TP_CLOCK_REPLY_BYTES);
    tp_put_clock_reply(&w, b->poll_[b->first_poll_].token, b->poll_[b->first_poll_].ticks, now);
  } else if (b->acks_ != 0) {
    b->item_ = BOARD_ACK_;
    board_open_(b, &w, TP_ACK, TP_ACK_BYTES);
    tp_put_ack(&w, b->ack_[b->first_ack_].command, b->ack_[b->first_ack_].result,
               b->ack_[b->first_ack_].request);
  } else if (b->descriptors_ != 0) {
    b->item_ = BOARD_DESCRIPTOR_;
    board_write_descriptor_(b, &w);
  } else if (b->status_due_) {
    b->item_ = BOARD_STATUS_;
    board_write_status_(b, &w, now);
  } else if (b->log_size_ != 0) {
    b->item_ = BOARD_LOG_;
    board_open_(b, &w, TP_LOG, (uint16_t)TP_LOG_BYTES((uint16_t)b->log_size_));
    tp_put_log(&w, b->log_level_, b->log_size_, b->log_ticks_);
    tp_bytes(&w, b->log_, b->log_size_);
  } else if (b->waiting_ != 0) {
    b->item_ = BOARD_SAMPLES_;
    board_write_samples_(b, &w);
  } else {
    return false;
  }
  b->tx_size_ = tp_end(&w);
  b->tx_at_ = 0;
  return true;
}

/** The first byte of the message was sent: remove it from its queue. */
static inline void board_gone_(struct board *b) {
  const struct tp_ack *ack = &b->ack_[b->first_ack_];
  switch (b->item_) {
    case BOARD_CLOCK_:
      b->polls_--;
      b->first_poll_ = (uint8_t)((b->first_poll_ + 1) & (BOARD_REPLIES - 1));
      break;
    case BOARD_ACK_:
      b->reboot_sent_ = ack->command == TP_REBOOT && ack->result == TP_OK;
      b->acks_--;
      b->first_ack_ = (uint8_t)((b->first_ack_ + 1) & (BOARD_REPLIES - 1));
      break;
    case BOARD_DESCRIPTOR_:
      b->descriptors_--;
      break;
    case BOARD_STATUS_:
      b->status_due_ = false;
      break;
    case BOARD_LOG_:
      b->log_size_ = 0;
      if (b->logs_lost != 0) {
        board_log(b, TP_WARNING, "? log lines lost (9: or more)");
        b->log_[0] = (uint8_t)('0' + ((b->logs_lost > 9) ? 9 : b->logs_lost));
        b->logs_lost = 0;
      }
      break;
    default:
      if (++b->next_array_ == b->config->count) {
        b->next_array_ = 0;
        board_remove_(b, 0);
      }
  }
}

/** Send as much of the transmit buffer as the line takes; false if it takes nothing now. */
static inline bool board_put_(struct board *b) {
#if BOARD_CAN
  struct tp_can_frame frame;
  uint8_t *transfer = &b->transfer_[(b->tx_[0] - 1) % 6];
  tp_can_segment(b->tx_, b->tx_size_, b->tx_at_, b->config->fd, *transfer, &frame);
  if (!b->port->send(b->port->self, &frame)) return false;
  if (b->tx_at_++ == 0) board_gone_(b);
  if (frame.data[frame.size - 1] & TP_CAN_END) {
    *transfer = (uint8_t)((*transfer + 1) & TP_CAN_ID);
    b->item_ = BOARD_NONE_;
  }
#else
  size_t n = b->port->write(b->port->self, b->tx_ + b->tx_at_, (size_t)(b->tx_size_ - b->tx_at_));
  if (n == 0) return false;
  if (b->tx_at_ == 0) board_gone_(b);
  b->tx_at_ = (uint16_t)(b->tx_at_ + n);
  if (b->tx_at_ == b->tx_size_) b->item_ = BOARD_NONE_;
#endif
  if (b->item_ == BOARD_NONE_) b->tx_at_ = 0;
  return true;
}

static inline void board_transmit_(struct board *b) {
#if !BOARD_CAN
  if (!b->greeted_) { /* separates the first frame from garbage on the line */
    static const uint8_t zero = 0;
    if (b->port->write(b->port->self, &zero, 1) == 0) return;
    b->greeted_ = true;
  }
#endif
  for (;;) {
    /* A queued clock reply must not keep an old stamp, nor wait for a message not yet started. */
    if (b->tx_at_ == 0 && b->polls_ != 0) b->item_ = BOARD_NONE_;
    if (b->item_ == BOARD_NONE_ && (b->reboot_sent_ || !board_compose_(b))) return;
    if (!board_put_(b)) return;
    if (b->reboot_sent_ && b->item_ == BOARD_NONE_) {
      b->reboot_from_ = b->port->ticks(b->port->self);
      return;
    }
  }
}

/** Do all that is due now; see the top of this file. */
static inline void board_poll(struct board *b) {
  const struct board_port *port = b->port;
  uint32_t now = port->ticks(port->self);
  if (b->reboot_sent_ && b->item_ == BOARD_NONE_) {
    /* Wait 16 ms for the answer to be sent. */
    if (now - b->reboot_from_ >= b->config->tick_hz >> 6) port->reboot(port->self);
    return;
  }
  while (now - b->second_ >= b->config->tick_hz) {
    b->second_ += b->config->tick_hz;
    b->uptime_s_++;
    b->status_due_ = true;
  }
  board_receive_(b);
  board_sample_(b);
  board_transmit_(b);
}

#endif
