/* SPDX-License-Identifier: Apache-2.0 */
/**
 * The headers as a shared library, for tests in Python: codec, receivers, the reference board with
 * a line and a clock set by the caller, and a bus of modelled chips.
 *
 * The numbers of a message are passed as int64_t `v`, names and texts as bytes `blob`, in the order
 * of its fields.
 */
#include <stdlib.h>
#include <string.h>

#include "reference_board.h"

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT
#endif

/* ---- Codec --------------------------------------------------------------------------------------- */

EXPORT uint32_t bridge_crc(const uint8_t *bytes, size_t n);
EXPORT int bridge_encode(int type, int board, const int64_t *v, const uint8_t *blob, int stuffed,
                         uint8_t *out, int capacity);
EXPORT int bridge_decode(int type, const uint8_t *p, int n, int64_t *v, uint8_t *blob);

uint32_t bridge_crc(const uint8_t *bytes, size_t n) { return tp_crc(bytes, n); }

static struct tp_descriptor descriptor_of(const int64_t *v, const uint8_t *blob) {
  struct tp_descriptor m;
  m.major = (uint8_t)v[0];
  m.minor = (uint8_t)v[1];
  memcpy(m.unique_id, blob, 8);
  memcpy(m.model, blob + 8, 16);
  memcpy(m.firmware, blob + 24, 16);
  m.tick_hz = (uint32_t)v[2];
  m.max_rate_mhz = (uint32_t)v[3];
  m.count = (uint8_t)v[4];
  m.stride_bytes = 32;
  return m;
}

int bridge_encode(int type, int board, const int64_t *v, const uint8_t *blob, int stuffed,
                  uint8_t *out, int capacity) {
  struct tp_writer w;
  uint16_t length = 0;
  int i;
  switch (type) {
    case TP_DESCRIPTOR: length = (uint16_t)TP_DESCRIPTOR_BYTES(v[4]); break;
    case TP_SAMPLES: length = (uint16_t)TP_SAMPLES_BYTES(v[1]); break;
    case TP_STATUS: length = TP_STATUS_BYTES; break;
    case TP_CLOCK_REPLY: length = TP_CLOCK_REPLY_BYTES; break;
    case TP_LOG: length = (uint16_t)TP_LOG_BYTES(v[1]); break;
    case TP_ACK: length = TP_ACK_BYTES; break;
    case TP_IDENTIFY: length = TP_IDENTIFY_BYTES; break;
    case TP_SET_RATE: length = TP_SET_RATE_BYTES; break;
    case TP_SET_GAIN: length = TP_SET_GAIN_BYTES; break;
    case TP_CLOCK_POLL: length = TP_CLOCK_POLL_BYTES; break;
    default: length = TP_REQUEST_BYTES;
  }
  tp_begin(&w, out, (uint16_t)capacity, (uint8_t)type, (uint8_t)board, length, stuffed != 0);
  switch (type) {
    case TP_DESCRIPTOR: {
      struct tp_descriptor m = descriptor_of(v, blob);
      tp_put_descriptor(&w, &m);
      for (i = 0; i < m.count; i++) {
        const int64_t *a = v + 5 + 7 * i;
        struct tp_array array;
        array.array = (uint8_t)a[0];
        array.chip = (uint8_t)a[1];
        array.rows = (uint8_t)a[2];
        array.columns = (uint8_t)a[3];
        array.pitch_um = (uint32_t)a[4];
        array.lsb_xy_nt = (uint32_t)a[5];
        array.lsb_z_nt = (uint32_t)a[6];
        memcpy(array.name, blob + 40 + 16 * i, 16);
        tp_put_array(&w, &array);
      }
      break;
    }
    case TP_SAMPLES: {
      struct tp_samples m;
      m.array = (uint8_t)v[0];
      m.taxels = (uint8_t)v[1];
      m.temperature_cc = (int16_t)v[2];
      m.sequence = (uint32_t)v[3];
      m.ticks = (uint32_t)v[4];
      tp_put_samples(&w, &m);
      for (i = 0; i < 3 * m.taxels; i++) tp_u16(&w, (uint16_t)(int16_t)v[5 + i]);
      for (i = 0; i < m.taxels; i++) tp_u8(&w, (uint8_t)v[5 + 3 * m.taxels + i]);
      break;
    }
    case TP_STATUS: {
      struct tp_status m;
      m.uptime_ms_low = (uint32_t)v[0];
      m.uptime_ms_high = (uint32_t)v[1];
      m.cycles = (uint32_t)v[2];
      m.overruns = (uint32_t)v[3];
      m.rx_errors = (uint32_t)v[4];
      m.chip_errors = (uint32_t)v[5];
      m.rate_mhz = (uint32_t)v[6];
      m.reset_cause = (uint8_t)v[7];
      tp_put_status(&w, &m);
      break;
    }
    case TP_CLOCK_REPLY:
      tp_put_clock_reply(&w, (uint32_t)v[0], (uint32_t)v[1], (uint32_t)v[2]);
      break;
    case TP_LOG:
      tp_put_log(&w, (uint8_t)v[0], (uint8_t)v[1], (uint32_t)v[2]);
      tp_bytes(&w, blob, (uint16_t)v[1]);
      break;
    case TP_ACK:
      tp_put_ack(&w, (uint8_t)v[0], (uint8_t)v[1], (uint16_t)v[2]);
      break;
    case TP_IDENTIFY: {
      struct tp_identify m;
      m.request = (uint16_t)v[0];
      m.major = (uint8_t)v[1];
      m.minor = (uint8_t)v[2];
      tp_put_identify(&w, &m);
      break;
    }
    case TP_SET_RATE: {
      struct tp_set_rate m;
      m.request = (uint16_t)v[0];
      m.rate_mhz = (uint32_t)v[1];
      tp_put_set_rate(&w, &m);
      break;
    }
    case TP_SET_GAIN: {
      struct tp_set_gain m;
      m.request = (uint16_t)v[0];
      m.array = (uint8_t)v[1];
      m.gain = (uint8_t)v[2];
      m.resolution = (uint8_t)v[3];
      m.oversampling = (uint8_t)v[4];
      m.filter = (uint8_t)v[5];
      tp_put_set_gain(&w, &m);
      break;
    }
    case TP_CLOCK_POLL: tp_u32(&w, (uint32_t)v[0]); break;
    default: tp_u16(&w, (uint16_t)v[0]);
  }
  return tp_end(&w);
}

int bridge_decode(int type, const uint8_t *p, int size, int64_t *v, uint8_t *blob) {
  uint16_t n = (uint16_t)size;
  enum tp_event event;
  int i;
  switch (type) {
    case TP_DESCRIPTOR: {
      struct tp_descriptor m;
      event = tp_get_descriptor(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.major;
      v[1] = m.minor;
      v[2] = m.tick_hz;
      v[3] = m.max_rate_mhz;
      v[4] = m.count;
      memcpy(blob, m.unique_id, 8);
      memcpy(blob + 8, m.model, 16);
      if (m.major == TP_MAJOR) memcpy(blob + 24, m.firmware, 16);
      for (i = 0; i < m.count; i++) {
        struct tp_array a;
        int64_t *to = v + 5 + 7 * i;
        event = tp_get_array(p, n, (uint8_t)i, &a);
        if (event != TP_PACKET) return (int)event;
        to[0] = a.array;
        to[1] = a.chip;
        to[2] = a.rows;
        to[3] = a.columns;
        to[4] = a.pitch_um;
        to[5] = a.lsb_xy_nt;
        to[6] = a.lsb_z_nt;
        memcpy(blob + 40 + 16 * i, a.name, 16);
      }
      return (int)event;
    }
    case TP_SAMPLES: {
      struct tp_samples m;
      event = tp_get_samples(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.array;
      v[1] = m.taxels;
      v[2] = m.temperature_cc;
      v[3] = m.sequence;
      v[4] = m.ticks;
      for (i = 0; i < m.taxels; i++) {
        struct tp_taxel t = tp_get_taxel(p, (uint8_t)i);
        v[5 + 3 * i] = t.x;
        v[6 + 3 * i] = t.y;
        v[7 + 3 * i] = t.z;
        v[5 + 3 * m.taxels + i] = t.status;
      }
      return (int)event;
    }
    case TP_STATUS: {
      struct tp_status m;
      event = tp_get_status(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.uptime_ms_low;
      v[1] = m.uptime_ms_high;
      v[2] = m.cycles;
      v[3] = m.overruns;
      v[4] = m.rx_errors;
      v[5] = m.chip_errors;
      v[6] = m.rate_mhz;
      v[7] = m.reset_cause;
      return (int)event;
    }
    case TP_CLOCK_REPLY: {
      struct tp_clock_reply m;
      event = tp_get_clock_reply(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.token;
      v[1] = m.ticks_received;
      v[2] = m.ticks_sent;
      return (int)event;
    }
    case TP_LOG: {
      struct tp_log m;
      event = tp_get_log(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.level;
      v[1] = m.size_bytes;
      v[2] = m.ticks;
      memcpy(blob, m.text, m.size_bytes);
      return (int)event;
    }
    case TP_ACK: {
      struct tp_ack m;
      event = tp_get_ack(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.command;
      v[1] = m.result;
      v[2] = m.request;
      return (int)event;
    }
    case TP_IDENTIFY: {
      struct tp_identify m;
      event = tp_get_identify(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.request;
      v[1] = m.major;
      v[2] = m.minor;
      return (int)event;
    }
    case TP_SET_RATE: {
      struct tp_set_rate m;
      event = tp_get_set_rate(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.request;
      v[1] = m.rate_mhz;
      return (int)event;
    }
    case TP_SET_GAIN: {
      struct tp_set_gain m;
      event = tp_get_set_gain(p, n, &m);
      if (event != TP_PACKET) return (int)event;
      v[0] = m.request;
      v[1] = m.array;
      v[2] = m.gain;
      v[3] = m.resolution;
      v[4] = m.oversampling;
      v[5] = m.filter;
      return (int)event;
    }
    case TP_CLOCK_POLL: {
      uint32_t token;
      event = tp_get_clock_poll(p, n, &token);
      if (event == TP_PACKET) v[0] = token;
      return (int)event;
    }
    case TP_START:
    case TP_STOP:
    case TP_REBOOT: {
      uint16_t request;
      event = tp_get_request(p, n, &request);
      if (event == TP_PACKET) v[0] = request;
      return (int)event;
    }
    default: return (int)TP_UNKNOWN_TYPE;
  }
}

/* ---- Receivers: packets are returned one after another, each preceded by its size in two bytes
 * --- */

struct receiver {
  struct tp_serial_rx serial;
  struct tp_can_rx can;
  struct tp_can_slot *slots;
  uint8_t *memory;
};

EXPORT struct receiver *bridge_receiver(int slots, int hold);
EXPORT void bridge_receiver_free(struct receiver *r);
EXPORT int bridge_serial_feed(struct receiver *r, const uint8_t *bytes, int n, uint32_t *counts,
                              uint8_t *out);
EXPORT int bridge_can_feed(struct receiver *r, uint32_t identifier, const uint8_t *data, int size,
                           int fd, uint32_t *counts, uint8_t *out);
EXPORT int bridge_segment(const uint8_t *packet, int size, int k, int fd, int transfer,
                          uint32_t *identifier, uint8_t *data);

struct receiver *bridge_receiver(int slots, int hold) {
  struct receiver *r = (struct receiver *)calloc(1, sizeof *r);
  if (r == NULL) return NULL;
  r->slots = (struct tp_can_slot *)calloc((size_t)slots, sizeof *r->slots);
  r->memory = (uint8_t *)calloc((size_t)slots + 1, (size_t)hold);
  if (r->slots == NULL || r->memory == NULL) {
    bridge_receiver_free(r);
    return NULL;
  }
  tp_serial_reset(&r->serial, r->memory + (size_t)slots * (size_t)hold, (uint16_t)hold);
  tp_can_reset(&r->can, r->slots, (uint8_t)slots, r->memory, (uint16_t)hold);
  return r;
}

void bridge_receiver_free(struct receiver *r) {
  if (r == NULL) return;
  free(r->slots);
  free(r->memory);
  free(r);
}

/** Count the event, and append a whole packet, as far as it was held, to `out`. */
static int keep_packet(enum tp_event event, const struct tp_packet *p, uint32_t *counts, uint8_t *out) {
  int64_t v[600];
  uint8_t blob[320];
  uint16_t held;
  if (event == TP_NOTHING) return 0;
  if (event == TP_PACKET) {
    event = (enum tp_event)bridge_decode(tp_packet_type(p), tp_payload(p), tp_payload_size(p), v,
                                        blob);
  }
  counts[event]++;
  if (event != TP_PACKET) return 0;
  held = (uint16_t)(TP_HEADER + tp_payload_size(p));
  out[0] = (uint8_t)(held & 255);
  out[1] = (uint8_t)(held >> 8);
  memcpy(out + 2, p->bytes, held);
  return 2 + held;
}

int bridge_serial_feed(struct receiver *r, const uint8_t *bytes, int n, uint32_t *counts,
                       uint8_t *out) {
  int size = 0;
  int i;
  for (i = 0; i < n; i++) {
    enum tp_event event = tp_serial_push(&r->serial, bytes[i]);
    size += keep_packet(event, &r->serial.packet, counts, out + size);
  }
  return size;
}

int bridge_can_feed(struct receiver *r, uint32_t identifier, const uint8_t *data, int size, int fd,
                    uint32_t *counts, uint8_t *out) {
  struct tp_can_frame frame;
  enum tp_event event;
  frame.identifier = identifier;
  frame.size = (uint8_t)((size > 64) ? 255 : size);
  frame.fd = fd != 0;
  if (size <= 64) memcpy(frame.data, data, (size_t)size);
  event = tp_can_push(&r->can, &frame);
  counts[TP_INTERRUPTED] = r->can.interrupted;
  return keep_packet(event, &r->can.packet, counts, out);
}

int bridge_segment(const uint8_t *packet, int size, int k, int fd, int transfer,
                   uint32_t *identifier, uint8_t *data) {
  struct tp_can_frame frame;
  tp_can_segment(packet, (uint16_t)size, (uint16_t)k, fd != 0, (uint8_t)transfer, &frame);
  *identifier = frame.identifier;
  memcpy(data, frame.data, frame.size);
  return frame.size;
}

/* ---- The reference board on a line of memory -------------------------------------------------------- */

struct bench {
  struct reference reference;
  uint32_t now_us;
  uint32_t room;       /* bytes (frames) that the line still takes */
  uint8_t *in;
  size_t in_size;
  size_t in_at;
  uint8_t out[1 << 16];
  size_t out_size;
  uint32_t reboots;
};

EXPORT struct bench *bench_new(int node, int fd);
EXPORT void bench_free(struct bench *t);
EXPORT int bench_poll(struct bench *t, uint32_t now_us, uint32_t room, const uint8_t *in, int n,
                      uint8_t *out);
EXPORT void bench_log(struct bench *t, int level, const char *text);
EXPORT void bench_chip(struct bench *t, int chip, int dead, int holds_bus, int resets, int slow);
EXPORT void bench_counters(struct bench *t, uint32_t *v);

static uint32_t bench_micros(void *self) { return ((struct bench *)self)->now_us; }

#if BOARD_CAN
/* A frame on the line of memory: identifier (4), fd, size, data. */
static bool bench_send(void *self, const struct tp_can_frame *frame) {
  struct bench *t = (struct bench *)((struct reference *)self)->self;
  uint8_t *to = t->out + t->out_size;
  if (t->room == 0 || t->out_size + 70 > sizeof t->out) return false;
  t->room--;
  memcpy(to, &frame->identifier, 4);
  to[4] = frame->fd;
  to[5] = frame->size;
  memcpy(to + 6, frame->data, frame->size);
  t->out_size += 6U + frame->size;
  return true;
}

static bool bench_receive(void *self, struct tp_can_frame *frame) {
  struct bench *t = (struct bench *)((struct reference *)self)->self;
  const uint8_t *from = t->in + t->in_at;
  if (t->in_at == t->in_size) return false;
  memcpy(&frame->identifier, from, 4);
  frame->fd = from[4] != 0;
  frame->size = from[5];
  memcpy(frame->data, from + 6, frame->size);
  t->in_at += 6U + frame->size;
  return true;
}
#else
static size_t bench_write(void *self, const uint8_t *bytes, size_t count) {
  struct bench *t = (struct bench *)((struct reference *)self)->self;
  if (count > t->room) count = t->room;
  if (count > sizeof t->out - t->out_size) count = sizeof t->out - t->out_size;
  memcpy(t->out + t->out_size, bytes, count);
  t->out_size += count;
  t->room -= (uint32_t)count;
  return count;
}

static size_t bench_read(void *self, uint8_t *bytes, size_t count) {
  struct bench *t = (struct bench *)((struct reference *)self)->self;
  if (count > t->in_size - t->in_at) count = t->in_size - t->in_at;
  memcpy(bytes, t->in + t->in_at, count);
  t->in_at += count;
  return count;
}
#endif

static void bench_reboot(void *self) {
  struct reference *r = (struct reference *)self;
  ((struct bench *)r->self)->reboots++;
  (void)reference_begin(r, TP_BY_COMMAND);
}

struct bench *bench_new(int node, int fd) {
  struct bench *t = (struct bench *)calloc(1, sizeof *t);
  struct reference *r;
  if (t == NULL) return NULL;
  r = &t->reference;
  r->self = t;
  r->micros = bench_micros;
  r->port.self = r;
#if BOARD_CAN
  r->config.node = (uint8_t)node;
  r->config.fd = fd != 0;
  r->port.send = bench_send;
  r->port.receive = bench_receive;
#else
  (void)node;
  (void)fd;
  r->port.write = bench_write;
  r->port.read = bench_read;
#endif
  r->port.reboot = bench_reboot;
  if (!reference_begin(r, TP_POWER_ON)) {
    bench_free(t);
    return NULL;
  }
  return t;
}

void bench_free(struct bench *t) {
  if (t != NULL) free(t->in);
  free(t);
}

/**
 * Poll once at `now_us` with `n` more bytes from the host and `room` on the line; returns bytes
 * sent.
 */
int bench_poll(struct bench *t, uint32_t now_us, uint32_t room, const uint8_t *in, int n,
               uint8_t *out) {
  int sent;
  if (n > 0) {
    uint8_t *grown = (uint8_t *)malloc(t->in_size - t->in_at + (size_t)n);
    if (grown == NULL) return -1;
    if (t->in != NULL) memcpy(grown, t->in + t->in_at, t->in_size - t->in_at);
    memcpy(grown + t->in_size - t->in_at, in, (size_t)n);
    free(t->in);
    t->in = grown;
    t->in_size += (size_t)n - t->in_at;
    t->in_at = 0;
  }
  t->now_us = now_us;
  t->room = room;
  board_poll(&t->reference.board);
  memcpy(out, t->out, t->out_size);
  sent = (int)t->out_size;
  t->out_size = 0;
  return sent;
}

void bench_log(struct bench *t, int level, const char *text) {
  board_log(&t->reference.board, (uint8_t)level, text);
}

void bench_chip(struct bench *t, int chip, int dead, int holds_bus, int resets, int slow) {
  struct model_chip *c = &t->reference.modelled[chip];
  c->dead = dead != 0;
  c->holds_bus = holds_bus != 0;
  c->slow_percent = (int8_t)slow;
  if (resets) model_power_on(c);
}

void bench_counters(struct bench *t, uint32_t *v) {
  const struct board *b = &t->reference.board;
  v[0] = b->cycles;
  v[1] = b->overruns;
  v[2] = b->rx_errors;
  v[3] = b->chip_errors;
  v[4] = t->reboots;
  v[5] = t->reference.arrays[0].recoveries;
  v[6] = (uint32_t)sizeof(struct board);
}

/* ---- A bus of modelled chips for the driver
 * ------------------------------------------------------ */

struct rig {
  struct model_bus model;
  struct model_chip modelled[8];
  struct mlx_bus bus;
  struct mlx_chip chips[8];
  struct mlx_array array;
  uint32_t now_us;
  int32_t nt[8][3];
  int16_t cc;
};

EXPORT struct rig *rig_new(int count, int spi, int ready_pin);
EXPORT void rig_free(struct rig *r);
EXPORT void rig_field(struct rig *r, const int32_t *nt, int cc);
EXPORT int rig_cycle(struct rig *r, uint32_t wait_us, int64_t *v);
EXPORT int rig_set(struct rig *r, int gain, int resolution, int oversampling, int filter,
                   uint32_t rate_mhz);
EXPORT void rig_chip(struct rig *r, int chip, int dead, int holds_bus, int resets, int slow);
EXPORT int rig_register(struct rig *r, int chip, int number);
EXPORT void rig_flip(struct rig *r, int flipped);
EXPORT int rig_burst(struct rig *r, int chip, int interval, uint32_t step_us, int steps,
                     int64_t *v);

static uint32_t rig_micros(void *self) { return ((struct rig *)self)->now_us; }

static void rig_field_(void *self, uint8_t chip, uint32_t us, int32_t nt[3], int16_t *cc) {
  struct rig *r = (struct rig *)self;
  (void)us;
  memcpy(nt, r->nt[chip], sizeof r->nt[chip]);
  *cc = r->cc;
}

struct rig *rig_new(int count, int spi, int ready_pin) {
  static const struct mlx_setting setting = {4, 0, 0, 3};
  struct rig *r = (struct rig *)calloc(1, sizeof *r);
  uint8_t i;
  if (r == NULL) return NULL;
  r->cc = 2500;
  r->model.chips = r->modelled;
  r->model.count = (uint8_t)count;
  r->model.spi = spi != 0;
  r->model.micros = rig_micros;
  r->model.field = rig_field_;
  r->model.self = r;
  r->bus.self = &r->model;
  r->bus.spi = spi != 0;
  r->bus.transfer = model_transfer;
  r->bus.recover = spi ? NULL : model_recover;
  r->bus.data_ready = ready_pin ? model_data_ready : NULL;
  r->bus.micros = model_micros;
  for (i = 0; i < count; i++) {
    model_make(&r->modelled[i], (uint8_t)(spi ? i : 0x0C + i));
    r->chips[i].address = r->modelled[i].address;
  }
  mlx_array_begin(&r->array, &r->bus, r->chips, (uint8_t)count, &setting);
  r->now_us += MLX_RESET_US;
  return r;
}

void rig_free(struct rig *r) { free(r); }

void rig_field(struct rig *r, const int32_t *nt, int cc) {
  memcpy(r->nt, nt, (size_t)r->model.count * 3 * sizeof *nt);
  r->cc = (int16_t)cc;
}

/**
 * One cycle: convert, wait, read. v: x, y, z, status of each chip, then temperature; returns 1 if
 * ready.
 */
int rig_cycle(struct rig *r, uint32_t wait_us, int64_t *v) {
  struct tp_taxel taxels[8];
  int16_t cc = -32768;
  int ready;
  int i;
  mlx_array_convert(&r->array);
  r->now_us += wait_us;
  ready = mlx_array_ready(&r->array);
  mlx_array_read(&r->array, taxels, &cc);
  for (i = 0; i < r->array.count; i++) {
    v[4 * i] = taxels[i].x;
    v[4 * i + 1] = taxels[i].y;
    v[4 * i + 2] = taxels[i].z;
    v[4 * i + 3] = taxels[i].status;
  }
  v[4 * i] = cc;
  return ready;
}

int rig_set(struct rig *r, int gain, int resolution, int oversampling, int filter,
            uint32_t rate_mhz) {
  struct mlx_setting s;
  s.gain = (uint8_t)gain;
  s.resolution = (uint8_t)resolution;
  s.oversampling = (uint8_t)oversampling;
  s.filter = (uint8_t)filter;
  return (int)mlx_array_set(&r->array, &s, rate_mhz, 400);
}

void rig_chip(struct rig *r, int chip, int dead, int holds_bus, int resets, int slow) {
  struct model_chip *c = &r->modelled[chip];
  c->dead = dead != 0;
  c->holds_bus = holds_bus != 0;
  c->slow_percent = (int8_t)slow;
  if (resets) model_power_on(c);
}

int rig_register(struct rig *r, int chip, int number) { return r->modelled[chip].registers[number]; }

void rig_flip(struct rig *r, int flipped) { r->array.flipped = flipped != 0; }

/** Burst: try to read every `step_us`; v: the result of each try (enum mlx_result). */
int rig_burst(struct rig *r, int chip, int interval, uint32_t step_us, int steps, int64_t *v) {
  struct mlx_chip *c = &r->chips[chip];
  enum mlx_result result = MLX_OK;
  int i;
  if (c->state != MLX_UP) result = mlx_configure(&r->bus, c, &r->array.setting);
  if (result == MLX_OK) result = mlx_burst(&r->bus, c, (uint8_t)interval);
  if (result != MLX_OK) return (int)result;
  for (i = 0; i < steps; i++) {
    r->now_us += step_us;
    v[i] = (int64_t)mlx_read(&r->bus, c, &r->array.setting, false);
  }
  return (int)mlx_exit(&r->bus, c);
}
