/* SPDX-License-Identifier: Apache-2.0 */
/**
 * The reference board on a Cortex-M3: Arm's MPS2 board with image AN385, as emulated by QEMU.
 *
 *     arm-none-eabi-gcc -std=c99 -mcpu=cortex-m3 -mthumb -O2 -nostartfiles --specs=nosys.specs \
 *       -T ports/qemu_mps2_an385/link.ld -o board.elf ports/qemu_mps2_an385/main.c
 *     qemu-system-arm -M mps2-an385 -display none -serial pty -kernel board.elf
 *
 * UART 0 is the serial line; the free-running CMSDK timer 0 is the clock (25 MHz, counting down,
 * converted to us).
 */
#include "../../test/reference_board.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define UART_DATA REGISTER(0x40004000UL)
#define UART_STATE REGISTER(0x40004004UL)
#define UART_CONTROL REGISTER(0x40004008UL)
#define UART_DIVIDER REGISTER(0x40004010UL)
#define TIMER_CONTROL REGISTER(0x40000000UL)
#define TIMER_VALUE REGISTER(0x40000004UL)
#define TIMER_RELOAD REGISTER(0x40000008UL)
#define RESET_CONTROL REGISTER(0xE000ED0CUL)

void image_stack_top(void); /* an address, given by the linker */
extern uint32_t image_data_from;
extern uint32_t image_data;
extern uint32_t image_data_end;
extern uint32_t image_bss;
extern uint32_t image_bss_end;

/* Survives a reset by command, so that the next start can report it. */
__attribute__((section(".kept"))) static uint32_t kept_cause;
#define BY_COMMAND 0x7265626FUL

static struct reference r;

/**
 * us since the start; the remainder of timer ticks is kept. Must be called before the timer wraps.
 */
static uint32_t micros(void *self) {
  static uint32_t last;
  static uint32_t rest;
  static uint32_t us;
  uint32_t now = 0xFFFFFFFFUL - TIMER_VALUE;
  uint32_t gone = now - last + rest;
  (void)self;
  last = now;
  us += gone / 25;
  rest = gone % 25;
  return us;
}

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count && (UART_STATE & 1U) == 0) UART_DATA = bytes[n++];
  return n;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count && (UART_STATE & 2U) != 0) bytes[n++] = (uint8_t)UART_DATA;
  return n;
}

static void reboot(void *self) {
  (void)self;
  kept_cause = BY_COMMAND;
  RESET_CONTROL = 0x05FA0004UL;
  for (;;) {
  }
}

void start(void);
void start(void) {
  uint32_t *to;
  const uint32_t *from = &image_data_from;
  uint8_t cause = (uint8_t)((kept_cause == BY_COMMAND) ? TP_BY_COMMAND : TP_POWER_ON);
  kept_cause = 0;
  for (to = &image_data; to != &image_data_end;) *to++ = *from++;
  for (to = &image_bss; to != &image_bss_end;) *to++ = 0;
  TIMER_RELOAD = 0xFFFFFFFFUL;
  TIMER_VALUE = 0xFFFFFFFFUL;
  TIMER_CONTROL = 1;
  UART_DIVIDER = 16;
  UART_CONTROL = 3;
  r.self = &r;
  r.micros = micros;
  r.port.self = &r;
  r.port.write = put;
  r.port.read = get;
  r.port.reboot = reboot;
  r.model.chips = NULL;
  if (reference_begin(&r, TP_POWER_ON)) {
    r.board.cause_ = cause; /* the modelled chips live in this memory: for them it was power-on */
    board_log(&r.board, TP_INFO, "reference board up");
    for (;;) board_poll(&r.board);
  }
  for (;;) {
  }
}

static void halt(void) {
  for (;;) {
  }
}

__attribute__((section(".vectors"), used)) static void (*const vectors[16])(void) = {
    image_stack_top, start, halt, halt, halt, halt, halt, halt,
    halt, halt, halt, halt, halt, halt, halt, halt};
