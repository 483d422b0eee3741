/* SPDX-License-Identifier: Apache-2.0 */
/* The Arduino names used by the sketches, to check them without an Arduino installation. */
#ifndef STAND_IN_ARDUINO_H
#define STAND_IN_ARDUINO_H
#include <stddef.h>
#include <stdint.h>

unsigned long micros();
int analogRead(int pin);
constexpr int A0 = 14;
struct SerialPort {
  void begin(unsigned long);
  int available();
  int availableForWrite();
  int read();
  size_t write(const uint8_t *, size_t);
  operator bool() const;
};
extern SerialPort Serial;
#endif
