// Five MLX90393 on I2C (addresses 0C to 10 hex), as on AnySkin boards, but with checked frames,
// device time, and gain and rate set by the host. Untried on silicon.
//
// Then, on the host:   tactile board-check --port /dev/ttyACM0
#include <Wire.h>

#define BOARD_MAX_TAXELS 5
#include <board.h>
#include <mlx90393.h>

static const uint32_t BUS_US = 2500;  // time to start and read five chips at 400 kHz

static const uint8_t uniqueId[8] = {1, 2, 3, 4, 5, 6, 7, 9};  // different on every board you make
static const board_array arrays[] = {{"pad", 1, 1, 5, 8000, 300, 484}};
static const board_config config = {uniqueId, "five-chips", "1.0", arrays, 1, 1000000, 150000, 100000};

static mlx_result transfer(void *, uint8_t address, const uint8_t *out, uint8_t out_count,
                           uint8_t *in, uint8_t in_count) {
  Wire.beginTransmission(address);
  Wire.write(out, out_count);
  if (Wire.endTransmission(false) != 0) return MLX_NACK;
  if (Wire.requestFrom(address, in_count) != in_count) return MLX_NACK;
  for (uint8_t i = 0; i < in_count; i++) in[i] = static_cast<uint8_t>(Wire.read());
  return MLX_OK;
}

static uint32_t ticks(void *) { return micros(); }

static const mlx_bus bus = {nullptr, false, transfer, nullptr, nullptr, ticks};
static const mlx_setting defaults = {4, 0, 0, 3};
static mlx_chip chips[5];
static mlx_array pad;

static size_t writeBytes(void *, const uint8_t *bytes, size_t count) {
  size_t room = static_cast<size_t>(Serial.availableForWrite());
  return Serial.write(bytes, count < room ? count : room);
}

static size_t readBytes(void *, uint8_t *bytes, size_t count) {
  size_t n = 0;
  while (n < count && Serial.available() > 0) bytes[n++] = static_cast<uint8_t>(Serial.read());
  return n;
}

static void convert(void *) { mlx_array_convert(&pad); }

static bool sample(void *, uint8_t, tp_taxel *taxels, int16_t *temperature_cc) {
  if (!mlx_array_ready(&pad)) return false;
  mlx_array_read(&pad, taxels, temperature_cc);
  return true;
}

static tp_answer setGain(void *, uint8_t, const tp_set_gain *codes, uint32_t rate_mhz) {
  mlx_setting wanted = {codes->gain, codes->resolution, codes->oversampling, codes->filter};
  return mlx_array_set(&pad, &wanted, rate_mhz, BUS_US);
}

static uint32_t scales(void *, uint8_t, uint32_t *xy_nt, uint32_t *z_nt) {
  mlx_scales(&pad.setting, xy_nt, z_nt);
  return mlx_max_rate_mhz(&pad.setting, BUS_US);
}

static void reboot(void *);

static board theBoard;
static const board_port port = {nullptr, writeBytes, readBytes, ticks, sample,
                                convert, setGain,    scales,    reboot};

static void begin(uint8_t cause) {
  for (uint8_t i = 0; i < 5; i++) chips[i].address = static_cast<uint8_t>(0x0C + i);
  mlx_array_begin(&pad, &bus, chips, 5, &defaults);
  (void)board_begin(&theBoard, &config, &port, cause);
}

// If the microcontroller can reset itself, do that instead.
static void reboot(void *) { begin(TP_BY_COMMAND); }

void setup() {
  Serial.begin(115200);
  Wire.begin();
  Wire.setClock(400000);
  begin(TP_POWER_ON);
}

void loop() { board_poll(&theBoard); }
