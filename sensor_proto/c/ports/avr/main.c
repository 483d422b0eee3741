/* SPDX-License-Identifier: Apache-2.0 */
/**
 * The reference board on an ATmega328P at 16 MHz (Arduino Uno, Nano), UART at 115200 bit/s.
 *
 *     avr-gcc -std=c99 -mmcu=atmega328p -DF_CPU=16000000UL -Os -o board.elf ports/avr/main.c
 *
 * Timer 1 runs freely at 2 MHz; ticks are us. An interrupt receives the bytes of the host, as the
 * UART holds only two; bytes without room are counted as refused.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/wdt.h>

#define BOARD_CYCLES 3
#define BOARD_LOG_TEXT 20
#define REFERENCE_BUS_US 5000 /* computing modelled chips is slow on 8 bits: 127 Hz at most */
#include "../../test/reference_board.h"

static volatile uint8_t rx[256]; /* indices of 8 bits wrap by themselves */
static volatile uint8_t rx_in;
static volatile uint8_t rx_out;
static volatile uint16_t rx_lost;
static volatile uint16_t timer_high;

/* Not initialised at start: tells a reset by command from one by the watchdog. */
static uint16_t kept_cause __attribute__((section(".noinit")));
#define BY_COMMAND 0x7265U

static struct reference r;

ISR(USART_RX_vect) {
  uint8_t byte = UDR0;
  uint8_t next = (uint8_t)(rx_in + 1);
  if (next == rx_out) {
    rx_lost++;
    return;
  }
  rx[rx_in] = byte;
  rx_in = next;
}

ISR(TIMER1_OVF_vect) { timer_high++; }

static uint32_t micros(void *self) {
  uint8_t flags = SREG;
  uint16_t low;
  uint32_t high;
  (void)self;
  cli();
  low = TCNT1;
  high = timer_high;
  if ((TIFR1 & (1 << TOV1)) != 0 && low < 0x8000U) high++; /* not yet served */
  SREG = flags;
  /* 48 bits of half us; the low 32 bits in whole us are kept and wrap at 2^32 us. */
  return high << 15 | low >> 1;
}

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count && (UCSR0A & (1 << UDRE0)) != 0) UDR0 = bytes[n++];
  return n;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count && rx_out != rx_in) {
    bytes[n++] = rx[rx_out];
    rx_out = (uint8_t)(rx_out + 1);
  }
  return n;
}

static void reboot(void *self) {
  (void)self;
  kept_cause = BY_COMMAND;
  cli();
  wdt_enable(WDTO_15MS);
  for (;;) {
  }
}

int main(void) {
  uint8_t was = MCUSR;
  uint8_t cause = TP_POWER_ON;
  MCUSR = 0;
  wdt_disable();
  if (was & (1 << WDRF)) {
    cause = (uint8_t)((kept_cause == BY_COMMAND) ? TP_BY_COMMAND : TP_WATCHDOG);
  } else if ((was & (1 << BORF)) != 0 && (was & (1 << PORF)) == 0) {
    cause = TP_BROWN_OUT;
  }
  kept_cause = 0;
  TCCR1B = 1 << CS11; /* by 8 */
  TIMSK1 = 1 << TOIE1;
  UCSR0A = 1 << U2X0;
  UBRR0 = 16; /* 115200 bit/s, 2 % fast */
  UCSR0C = 1 << UCSZ01 | 1 << UCSZ00;
  UCSR0B = 1 << RXEN0 | 1 << TXEN0 | 1 << RXCIE0;
  sei();
  r.self = &r;
  r.micros = micros;
  r.port.self = &r;
  r.port.write = put;
  r.port.read = get;
  r.port.reboot = reboot;
  if (!reference_begin(&r, TP_POWER_ON)) return 1;
  r.board.cause_ = cause; /* the modelled chips live in this memory: for them it was power-on */
  for (;;) {
    uint8_t flags = SREG;
    cli();
    r.board.rx_errors += rx_lost;
    rx_lost = 0;
    SREG = flags;
    board_poll(&r.board);
  }
}
