// SPDX-License-Identifier: Apache-2.0
// The smallest board: four analogue inputs as the z of four taxels. Untried on silicon.
//
// Then, on the host:   tactile board-check --port /dev/ttyACM0
#define BOARD_MAX_TAXELS 4
#include <board.h>

static const uint8_t uniqueId[8] = {1, 2, 3, 4, 5, 6, 7, 8};  // different on every board you make

static const board_array arrays[] = {
    // name, chip, rows, columns, pitch in um, nT per count of x and y, nT per count of z
    {"pad", 0, 2, 2, 8000, 1000, 1000},
};

static const board_config config = {
    uniqueId, "four-taxels", "1.0", arrays, 1,
    1000000,  // ticks per second: micros()
    200000,   // highest rate, mHz
    100000,   // rate after a reset, mHz
};

static size_t writeBytes(void *, const uint8_t *bytes, size_t count) {
  size_t room = static_cast<size_t>(Serial.availableForWrite());
  return Serial.write(bytes, count < room ? count : room);
}

static size_t readBytes(void *, uint8_t *bytes, size_t count) {
  size_t n = 0;
  while (n < count && Serial.available() > 0) bytes[n++] = static_cast<uint8_t>(Serial.read());
  return n;
}

static uint32_t ticks(void *) { return micros(); }

static bool sample(void *, uint8_t, tp_taxel *taxels, int16_t *temperature_cc) {
  for (int i = 0; i < 4; i++) {
    taxels[i].x = taxels[i].y = 0;
    taxels[i].z = static_cast<int16_t>(analogRead(A0 + i));
    taxels[i].status = 0;
  }
  *temperature_cc = 2500;
  return true;
}

static void reboot(void *);

static board theBoard;
static const board_port port = {nullptr, writeBytes, readBytes, ticks, sample,
                                nullptr, nullptr,    nullptr,   reboot};

// If the microcontroller can reset itself, do that instead.
static void reboot(void *) { (void)board_begin(&theBoard, &config, &port, TP_BY_COMMAND); }

void setup() {
  Serial.begin(115200);
  (void)board_begin(&theBoard, &config, &port, TP_POWER_ON);
}

void loop() { board_poll(&theBoard); }
