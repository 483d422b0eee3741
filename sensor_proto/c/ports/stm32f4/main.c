/* SPDX-License-Identifier: Apache-2.0 */
/**
 * Port functions for an STM32F4 with ST's HAL: USART 2 receiving into a DMA ring, timer 2 as the
 * clock, I2C 1 for the chips. Untried on silicon: written from the documentation of the HAL. It
 * needs a project made by CubeMX (handles `huart2`, `htim2`, `hi2c1`; USART 2 RX DMA circular into
 * `rx`; timer 2 with 32 bits, prescaled to 1 MHz).
 *
 * Call `tactile_begin()` after CubeMX's initialisation, and `tactile_poll()` in the main loop.
 */
#include "stm32f4xx_hal.h"

#define BOARD_MAX_TAXELS 5
#include "board.h"
#include "mlx90393.h"

#define BUS_US 2500
#define RX_SIZE 256

extern UART_HandleTypeDef huart2;
extern TIM_HandleTypeDef htim2;
extern I2C_HandleTypeDef hi2c1;

void Error_Handler(void); /* provided by CubeMX */
void tactile_begin(void);
void tactile_poll(void);

static uint8_t rx[RX_SIZE];
static uint16_t rx_out;
static struct mlx_chip chips[5];
static struct mlx_array pad;
static struct board board;

static size_t put(void *self, const uint8_t *bytes, size_t count) {
  size_t n = 0;
  (void)self;
  while (n < count && __HAL_UART_GET_FLAG(&huart2, UART_FLAG_TXE)) huart2.Instance->DR = bytes[n++];
  return n;
}

static size_t get(void *self, uint8_t *bytes, size_t count) {
  uint16_t in = (uint16_t)(RX_SIZE - __HAL_DMA_GET_COUNTER(huart2.hdmarx));
  size_t n = 0;
  (void)self;
  while (n < count && rx_out != in % RX_SIZE) {
    bytes[n++] = rx[rx_out];
    rx_out = (uint16_t)((rx_out + 1) % RX_SIZE);
  }
  return n;
}

static uint32_t ticks(void *self) {
  (void)self;
  return __HAL_TIM_GET_COUNTER(&htim2);
}

static enum mlx_result transfer(void *self, uint8_t address, const uint8_t *out, uint8_t out_count,
                                uint8_t *in, uint8_t in_count) {
  uint16_t at = (uint16_t)(address << 1);
  (void)self;
  if (__HAL_I2C_GET_FLAG(&hi2c1, I2C_FLAG_BUSY)) return MLX_STUCK;
  if (HAL_I2C_Master_Transmit(&hi2c1, at, (uint8_t *)(uintptr_t)out, out_count, 2) != HAL_OK) {
    return MLX_NACK;
  }
  return (HAL_I2C_Master_Receive(&hi2c1, at, in, in_count, 2) == HAL_OK) ? MLX_OK : MLX_NACK;
}

static void recover(void *self) {
  (void)self;
  (void)HAL_I2C_DeInit(&hi2c1);
  (void)HAL_I2C_Init(&hi2c1);
}

static void convert(void *self) {
  (void)self;
  mlx_array_convert(&pad);
}

static bool sample(void *self, uint8_t array, struct tp_taxel *taxels, int16_t *temperature_cc) {
  (void)self;
  (void)array;
  if (!mlx_array_ready(&pad)) return false;
  mlx_array_read(&pad, taxels, temperature_cc);
  return true;
}

static enum tp_answer set_gain(void *self, uint8_t array, const struct tp_set_gain *codes,
                               uint32_t rate_mhz) {
  struct mlx_setting s = {codes->gain, codes->resolution, codes->oversampling, codes->filter};
  (void)self;
  (void)array;
  return mlx_array_set(&pad, &s, rate_mhz, BUS_US);
}

static uint32_t scales(void *self, uint8_t array, uint32_t *xy_nt, uint32_t *z_nt) {
  (void)self;
  (void)array;
  mlx_scales(&pad.setting, xy_nt, z_nt);
  return mlx_max_rate_mhz(&pad.setting, BUS_US);
}

static void reboot(void *self) {
  (void)self;
  NVIC_SystemReset();
}

void tactile_begin(void) {
  static const struct mlx_setting setting = {4, 0, 0, 3};
  static const struct mlx_bus bus = {NULL, false, transfer, recover, NULL, ticks};
  static const struct board_port port = {NULL, put, get, ticks, sample, convert, set_gain, scales, reboot};
  static const struct board_array arrays[] = {{"pad", 1, 1, 5, 8000, 300, 484}};
  static const struct board_config config = {
      (const uint8_t *)UID_BASE, "stm32-five", "1.0", arrays, 1, 1000000, 150000, 100000};
  uint8_t cause = TP_POWER_ON;
  if (__HAL_RCC_GET_FLAG(RCC_FLAG_SFTRST)) cause = TP_BY_COMMAND;
  if (__HAL_RCC_GET_FLAG(RCC_FLAG_IWDGRST)) cause = TP_WATCHDOG;
  __HAL_RCC_CLEAR_RESET_FLAGS();
  (void)HAL_UART_Receive_DMA(&huart2, rx, RX_SIZE);
  (void)HAL_TIM_Base_Start(&htim2);
  for (uint8_t i = 0; i < 5; i++) chips[i].address = (uint8_t)(0x0C + i);
  mlx_array_begin(&pad, &bus, chips, 5, &setting);
  if (!board_begin(&board, &config, &port, cause)) Error_Handler();
}

void tactile_poll(void) { board_poll(&board); }
