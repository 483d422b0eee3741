/* SPDX-License-Identifier: Apache-2.0 */
/**
 * The reference board on a pseudo-terminal of this machine (POSIX):
 *
 *     cc -std=c99 -O2 -o board ports/host/main.c      # in sensor_proto/c
 *     ./board ./board0 &
 *     tactiled --port ./board0        # or: tactile board-check --port ./board0
 *
 * It links the given path to the pseudo-terminal and removes the link at the end.
 */
#define _XOPEN_SOURCE 700

#include <errno.h>
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#include "../../test/reference_board.h"

static volatile sig_atomic_t ended;
static int master;

static void end(int number) {
  (void)number;
  ended = 1;
}

static uint32_t micros(void *self) {
  struct timespec now;
  (void)self;
  (void)clock_gettime(CLOCK_MONOTONIC, &now);
  return (uint32_t)((uint64_t)now.tv_sec * 1000000U + (uint64_t)now.tv_nsec / 1000U);
}

/** Whether a host has the other end open; if not, nothing is sent, as on a USB port. */
static bool is_open(void) {
  struct pollfd line;
  line.fd = master;
  line.events = 0;
  return poll(&line, 1, 0) >= 0 && (line.revents & POLLHUP) == 0;
}

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  ssize_t n;
  (void)self;
  if (!is_open()) return 0;
  n = write(master, bytes, count);
  return (n > 0) ? (size_t)n : 0;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  ssize_t n = read(master, bytes, count);
  (void)self;
  return (n > 0) ? (size_t)n : 0;
}

static void reboot(void *self) { (void)reference_begin((struct reference *)self, TP_BY_COMMAND); }

/** Open a pseudo-terminal in raw mode and link `path` to it; false with the reason on stderr. */
static bool open_line(const char *path) {
  struct termios raw;
  int slave;
  master = posix_openpt(O_RDWR | O_NOCTTY);
  if (master < 0 || grantpt(master) != 0 || unlockpt(master) != 0) {
    perror("no pseudo-terminal");
    return false;
  }
  slave = open(ptsname(master), O_RDWR | O_NOCTTY);
  if (slave < 0 || tcgetattr(slave, &raw) != 0) {
    perror(ptsname(master));
    return false;
  }
  raw.c_iflag &= ~(tcflag_t)(BRKINT | ICRNL | INPCK | ISTRIP | IXON);
  raw.c_oflag &= ~(tcflag_t)OPOST;
  raw.c_lflag &= ~(tcflag_t)(ECHO | ICANON | IEXTEN | ISIG);
  raw.c_cflag |= CS8;
  if (tcsetattr(slave, TCSANOW, &raw) != 0) {
    perror(ptsname(master));
    return false;
  }
  (void)close(slave);
  if (fcntl(master, F_SETFL, O_NONBLOCK) != 0) {
    perror(ptsname(master));
    return false;
  }
  if (symlink(ptsname(master), path) != 0 &&
      (errno != EEXIST || unlink(path) != 0 || symlink(ptsname(master), path) != 0)) {
    (void)fprintf(stderr, "%s cannot be made a link to %s; give another path\n", path,
                  ptsname(master));
    return false;
  }
  return true;
}

int main(int argc, char **argv) {
  static struct reference r;
  struct timespec pause = {0, 200000};
  struct sigaction action = {0};
  if (argc != 2) {
    (void)fprintf(stderr, "usage: %s PATH, where the board's port is to be found\n", argv[0]);
    return 2;
  }
  if (!open_line(argv[1])) return 3;
  action.sa_handler = end;
  (void)sigaction(SIGINT, &action, NULL);
  (void)sigaction(SIGTERM, &action, NULL);
  r.self = &r;
  r.micros = micros;
  r.port.self = &r;
  r.port.write = put;
  r.port.read = get;
  r.port.reboot = reboot;
  if (!reference_begin(&r, TP_POWER_ON)) return 1;
  board_log(&r.board, TP_INFO, "reference board up");
  (void)printf("%s board -> tactiled --port %s\n", REFERENCE_MODEL, argv[1]);
  (void)fflush(stdout);
  while (!ended) {
    board_poll(&r.board);
    (void)nanosleep(&pause, NULL);
  }
  (void)unlink(argv[1]);
  (void)fprintf(stderr, "%s: %lu cycles, %lu overruns\n", argv[1], (unsigned long)r.board.cycles,
                (unsigned long)r.board.overruns);
  return 0;
}
