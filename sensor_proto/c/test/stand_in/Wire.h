/* SPDX-License-Identifier: Apache-2.0 */
/* The Arduino I2C names used by the sketches. */
#ifndef STAND_IN_WIRE_H
#define STAND_IN_WIRE_H
#include <stddef.h>
#include <stdint.h>

struct TwoWire {
  void begin();
  void setClock(uint32_t);
  void beginTransmission(uint8_t);
  size_t write(const uint8_t *, size_t);
  uint8_t endTransmission(bool);
  uint8_t requestFrom(uint8_t, uint8_t);
  int read();
};
extern TwoWire Wire;
#endif
