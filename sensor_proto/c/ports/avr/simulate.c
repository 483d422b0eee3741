/* SPDX-License-Identifier: Apache-2.0 */
/**
 * An ATmega328P in simavr whose UART is a pseudo-terminal, no faster than real time (POSIX):
 *
 *     cc -o simulate ports/avr/simulate.c -lsimavr -lelf
 *     ./simulate board.elf ./board0
 */
#define _XOPEN_SOURCE 700
#define _DEFAULT_SOURCE

#include <fcntl.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define HZ 16000000U

static volatile sig_atomic_t ended;
static int master;
static int room = 1; /* the UART accepts a byte */

static void end(int number) {
  (void)number;
  ended = 1;
}

static void on_output(struct avr_irq_t *irq, uint32_t value, void *self) {
  unsigned char byte = (unsigned char)value;
  (void)irq;
  (void)self;
  if (write(master, &byte, 1) != 1) return; /* a UART does not know whether anyone listens */
}

static void on_ready(struct avr_irq_t *irq, uint32_t value, void *self) {
  (void)irq;
  (void)value;
  (void)self;
  room = 1;
}

static void on_full(struct avr_irq_t *irq, uint32_t value, void *self) {
  (void)irq;
  (void)value;
  (void)self;
  room = 0;
}

int main(int argc, char **argv) {
  static elf_firmware_t image;
  struct termios raw;
  struct timespec begun;
  avr_t *avr;
  avr_irq_t *in;
  uint32_t flags = 0;
  uint64_t next_byte = 0;
  int slave;
  if (argc != 3 || elf_read_firmware(argv[1], &image) != 0) {
    (void)fprintf(stderr, "usage: %s IMAGE.elf PATH, where the port is to be found\n", argv[0]);
    return 2;
  }
  master = posix_openpt(O_RDWR | O_NOCTTY);
  if (master < 0 || grantpt(master) != 0 || unlockpt(master) != 0) return 3;
  slave = open(ptsname(master), O_RDWR | O_NOCTTY); /* kept open: a UART never hangs up */
  if (slave < 0 || tcgetattr(slave, &raw) != 0) return 3;
  cfmakeraw(&raw);
  if (tcsetattr(slave, TCSANOW, &raw) != 0 || fcntl(master, F_SETFL, O_NONBLOCK) != 0) return 3;
  (void)unlink(argv[2]);
  if (symlink(ptsname(master), argv[2]) != 0) return 3;
  (void)signal(SIGINT, end);
  (void)signal(SIGTERM, end);
  avr = avr_make_mcu_by_name("atmega328p");
  if (avr == NULL) return 1;
  avr_init(avr);
  avr->frequency = HZ;
  avr->log = 0;
  avr_load_firmware(avr, &image);
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  in = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), on_output, NULL);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), on_ready, NULL);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), on_full, NULL);
  (void)printf("simavr -> %s\n", argv[2]);
  (void)fflush(stdout);
  (void)clock_gettime(CLOCK_MONOTONIC, &begun);
  while (!ended) {
    avr_cycle_count_t until = avr->cycle + HZ / 2000;
    struct timespec now;
    uint64_t due_us;
    uint64_t gone_us;
    while (avr->cycle < until && !ended) {
      int state;
      if (room && avr->cycle >= next_byte) {
        unsigned char byte;
        if (read(master, &byte, 1) == 1) avr_raise_irq(in, byte);
        next_byte = avr->cycle + HZ / 11520; /* ten bits at 115200 bit/s */
      }
      state = avr_run(avr);
      if (state == cpu_Done || state == cpu_Crashed) {
        (void)fprintf(stderr, "the program ended\n");
        return 1;
      }
    }
    (void)clock_gettime(CLOCK_MONOTONIC, &now);
    gone_us = (uint64_t)(now.tv_sec - begun.tv_sec) * 1000000U + (uint64_t)now.tv_nsec / 1000U -
              (uint64_t)begun.tv_nsec / 1000U;
    due_us = avr->cycle / (HZ / 1000000U);
    if (due_us > gone_us) {
      (void)usleep((useconds_t)(due_us - gone_us));
    }
  }
  (void)unlink(argv[2]);
  return 0;
}
