/* SPDX-License-Identifier: Apache-2.0 */
/* A receiver of commands and a writer of acks: linked to measure the size of the bare codec. */
#include "tactile_proto.h"

#define size_register (*(volatile uint8_t *)0x44)
static struct tp_serial_rx rx;
static uint8_t held[12];
static uint8_t frame[TP_SERIAL_BYTES(TP_ACK_BYTES)];

int main(void) {
  tp_serial_reset(&rx, held, sizeof held);
  for (;;) {
    uint16_t request;
    if (tp_serial_push(&rx, size_register) == TP_PACKET &&
        tp_get_request(tp_payload(&rx.packet), tp_payload_size(&rx.packet), &request) == TP_PACKET) {
      struct tp_writer w;
      uint16_t n;
      uint16_t i;
      tp_begin(&w, frame, sizeof frame, TP_ACK, 0, TP_ACK_BYTES, true);
      tp_put_ack(&w, tp_packet_type(&rx.packet), TP_OK, request);
      n = tp_end(&w);
      for (i = 0; i < n; i++) size_register = frame[i];
    }
  }
}
