/* SPDX-License-Identifier: Apache-2.0 */
/**
 * libFuzzer entry point for receivers, readers and the reference board:
 *
 *     clang -std=c99 -g -O1 -fsanitize=fuzzer,address,undefined -o fuzz test/fuzz.c
 *     ./fuzz -runs=1000000 -max_len=2048
 *
 * The first byte selects a serial line, a CAN bus, or the payload readers alone.
 */
#include <stdlib.h>
#include <string.h>

#include "reference_board.h"

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size);

static uint32_t now_us;
static const uint8_t *input;
static size_t left;
static size_t sent;

static uint32_t micros(void *self) {
  (void)self;
  return now_us += 37;
}

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  (void)self;
  if (sent + count > 3000) return 0;
  sent += count;
  return bytes[count - 1] == 0 ? count : count / 2 + 1;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  (void)self;
  if (count > left) count = left;
  if (count != 0) memcpy(bytes, input, count);
  input += count;
  left -= count;
  return count;
}

static void reboot(void *self) { (void)reference_begin((struct reference *)self, TP_BY_COMMAND); }

/** Every reader gets its own copy, so that reading beyond the end is detected. */
static void read_payload(uint8_t type, const uint8_t *p, uint16_t n) {
  uint8_t *copy = (uint8_t *)malloc(n != 0 ? n : 1);
  struct tp_descriptor descriptor;
  struct tp_array array;
  struct tp_samples samples;
  struct tp_status status;
  struct tp_clock_reply reply;
  struct tp_log line;
  struct tp_ack ack;
  struct tp_identify identify;
  struct tp_set_rate rate;
  struct tp_set_gain gain;
  uint32_t token;
  uint16_t request;
  volatile uint32_t sum = type;
  uint8_t i;
  if (copy == NULL) return;
  if (n != 0) memcpy(copy, p, n);
  if (tp_get_descriptor(copy, n, &descriptor) == TP_PACKET) {
    for (i = 0; i < descriptor.count; i++) {
      if (tp_get_array(copy, n, i, &array) != TP_PACKET) abort();
    }
  }
  if (tp_get_samples(copy, n, &samples) == TP_PACKET) {
    for (i = 0; i < samples.taxels; i++) sum += tp_get_taxel(copy, i).status;
  }
  if (tp_get_log(copy, n, &line) == TP_PACKET) {
    for (i = 0; i < line.size_bytes; i++) sum += line.text[i];
  }
  (void)tp_get_status(copy, n, &status);
  (void)tp_get_clock_reply(copy, n, &reply);
  (void)tp_get_ack(copy, n, &ack);
  (void)tp_get_identify(copy, n, &identify);
  (void)tp_get_set_rate(copy, n, &rate);
  (void)tp_get_set_gain(copy, n, &gain);
  (void)tp_get_clock_poll(copy, n, &token);
  (void)tp_get_request(copy, n, &request);
  free(copy);
}

static void on_a_line(const uint8_t *data, size_t size) {
  static struct reference r;
  struct tp_serial_rx rx;
  uint8_t held[64];
  size_t i;
  tp_serial_reset(&rx, held, sizeof held);
  for (i = 0; i < size; i++) {
    if (tp_serial_push(&rx, data[i]) == TP_PACKET) {
      read_payload(tp_packet_type(&rx.packet), tp_payload(&rx.packet), tp_payload_size(&rx.packet));
    }
  }
  memset(&r, 0, sizeof r);
  now_us = 0;
  input = data;
  left = size;
  sent = 0;
  r.self = &r;
  r.micros = micros;
  r.port.self = &r;
  r.port.write = put;
  r.port.read = get;
  r.port.reboot = reboot;
  if (!reference_begin(&r, TP_POWER_ON)) abort();
  for (i = 0; i < 40; i++) {
    now_us += 1500;
    board_poll(&r.board);
  }
}

static void on_a_bus(const uint8_t *data, size_t size) {
  struct tp_can_rx rx;
  struct tp_can_slot slots[3];
  uint8_t held[3 * 20];
  tp_can_reset(&rx, slots, 3, held, 20);
  while (size >= 4) {
    struct tp_can_frame frame;
    uint8_t n = (uint8_t)(data[0] % 70);
    frame.identifier = tp_can_identifier(data[1], (uint8_t)(data[2] & 0x7F));
    if (data[3] & 1) frame.identifier ^= (uint32_t)data[3] << 20;
    frame.fd = (data[0] & 0x80) != 0;
    data += 4;
    size -= 4;
    frame.size = n;
    if (n > size) n = (uint8_t)size;
    memcpy(frame.data, data, n < TP_CAN_BYTES ? n : TP_CAN_BYTES);
    if (frame.size > n) frame.size = n;
    data += n;
    size -= n;
    if (tp_can_push(&rx, &frame) == TP_PACKET) {
      read_payload(tp_packet_type(&rx.packet), tp_payload(&rx.packet), tp_payload_size(&rx.packet));
    }
  }
}

/** Give packets a correct CRC, so that the fuzzer gets past the check. */
static void with_right_crcs(const uint8_t *data, size_t size) {
  uint8_t line[4096];
  uint16_t at = 0;
  while (size >= 4 && at < 2900) {
    struct tp_writer w;
    uint16_t n = data[1];
    uint16_t i;
    if (n > size - 2) n = (uint16_t)(size - 2);
    tp_begin(&w, line + at, (uint16_t)(sizeof line - at), data[0], 0, n, true);
    for (i = 0; i < n; i++) tp_u8(&w, data[2 + i]);
    at = (uint16_t)(at + tp_end(&w));
    data += 2 + n;
    size -= 2U + n;
  }
  on_a_line(line, at);
}

int LLVMFuzzerTestOneInput(const uint8_t *data, size_t size) {
  if (size == 0) return 0;
  switch (data[0] % 4) {
    case 0: on_a_line(data + 1, size - 1); break;
    case 1: on_a_bus(data + 1, size - 1); break;
    case 2: with_right_crcs(data + 1, size - 1); break;
    default: read_payload(0, data + 1, (uint16_t)((size > 1025) ? 1024 : size - 1));
  }
  return 0;
}
