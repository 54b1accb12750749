/* The board `mps2`: Arm's MPS2 with a Cortex-M3 (AN385) or a Cortex-M7 (AN500), as in QEMU.
 *
 * UART 0 is the line. QEMU has no pins: UART 1 names each change of one: microseconds, pin, value,
 * and takes S and s, which open and close the emergency stop. The hardware behind the pins is ideal.
 * An epoch is loaded into memory before the start, and whether the processor may sleep: the clock of
 * an emulator that counts instructions jumps when the processor sleeps and its host is late.
 */
#include "boards/board.h"
#include "boards/ideal.h"

#define REGISTER(address) (*(volatile uint32_t *)(address))
#define COUNTER REGISTER(0x40028018u)
#define PRESCALE REGISTER(0x4002801Cu)
#define CLOCK_MHZ 25u
#define TIMER_CTRL REGISTER(0x40000000u)
#define TIMER_VALUE REGISTER(0x40000004u)
#define TIMER_RELOAD REGISTER(0x40000008u)
#define TIMER_CLEAR REGISTER(0x4000000Cu)
#define LINE 0x40004000u
#define PINS 0x40005000u
#define UART_DATA 0x0u
#define UART_STATE 0x4u
#define UART_CTRL 0x8u
#define UART_CLEAR 0xCu
#define UART_BAUD 0x10u
#define STATE_OUT_FULL 1u
#define STATE_IN_FULL 2u
#define NVIC_ENABLE REGISTER(0xE000E100u)
#define NVIC_CLEAR REGISTER(0xE000E280u)
#define IRQ_LINE (1u << 0)
#define IRQ_TIMER (1u << 8)
#define CPACR REGISTER(0xE000ED88u)
#define EPOCH REGISTER(0x203FFFF0u)
#define AWAKE REGISTER(0x203FFFF4u) /* never sleep */
#define STARTS REGISTER(0x203FFFE0u) /* zero at power-up, kept by a reset */
#define WATCHDOG_LOAD REGISTER(0x40008000u)
#define WATCHDOG_CTRL REGISTER(0x40008008u)
#define WATCHDOG_FEED REGISTER(0x4000800Cu)
#define WATCHDOG_MS 500u /* twice until the reset: an emulator's processor waits for its host */

extern uint32_t data_load[], data_start[], data_end[], bss_start[], bss_end[], stack_top[];
int main(void);
void board_reset(void);

void board_reset(void) {
#ifdef __ARM_FP
  CPACR |= 0xFu << 20;
  __asm volatile("dsb\n isb");
#endif
  for (uint32_t *from = data_load, *to = data_start; to < data_end;) *to++ = *from++;
  for (uint32_t *to = bss_start; to < bss_end;) *to++ = 0;
  main();
}

static void halt(void) {
  for (;;) {
  }
}

__attribute__((section(".vectors"), used)) static void *const VECTORS[16] = {
    stack_top, (void *)board_reset, (void *)halt, (void *)halt, (void *)halt, (void *)halt};

static void put_byte(uint32_t uart, char byte) {
  while (REGISTER(uart + UART_STATE) & STATE_OUT_FULL) {
  }
  REGISTER(uart + UART_DATA) = (uint8_t)byte;
}

void show_pin(const char *pin, double value) {
  char data[64];
  struct text text;
  text_start(&text, data, sizeof data);
  format_pin(&text, pin, value);
  for (uint16_t k = 0; k < text.used; k++) put_byte(PINS, data[k]);
}

bool board_start(void) {
  PRESCALE = CLOCK_MHZ - 1u; /* the counter is free-running: no tick can be missed */
  for (uint32_t uart = LINE; uart <= PINS; uart += PINS - LINE) {
    REGISTER(uart + UART_BAUD) = CLOCK_MHZ * 1000000u / 115200u;
    REGISTER(uart + UART_CTRL) = uart == LINE ? 1u | 2u | 8u : 1u | 2u;
  }
  TIMER_RELOAD = TIMER_VALUE = CLOCK_MHZ * 1000u; /* wakes the processor each millisecond */
  TIMER_CTRL = 1u | 8u;
  WATCHDOG_LOAD = CLOCK_MHZ * 1000u * WATCHDOG_MS;
  WATCHDOG_CTRL = 3u; /* first NMI, which halts, then reset */
  for (const char *shown = "0 start 1\n"; *shown; shown++) put_byte(PINS, *shown); /* all low */
  __asm volatile("cpsid i");
  NVIC_ENABLE = IRQ_LINE | IRQ_TIMER;
  COUNTER = 0; /* it ran before: QEMU takes 40 ms to open its terminals */
  return true;
}

int64_t board_now_us(void) {
  static uint32_t before;
  static int64_t high;
  uint32_t count = COUNTER;
  if (count < before) high += INT64_C(1) << 32;
  before = count;
  return high | count;
}

/* Without a byte, sleep until one or the next millisecond. */
bool board_read(char *byte) {
  if (!(REGISTER(LINE + UART_STATE) & STATE_IN_FULL)) {
    if (!AWAKE) __asm volatile("wfi");
    TIMER_CLEAR = 1u;
    REGISTER(LINE + UART_CLEAR) = 2u;
    NVIC_CLEAR = IRQ_LINE | IRQ_TIMER;
    return false;
  }
  *byte = (char)REGISTER(LINE + UART_DATA);
  return true;
}

void board_send(const char *data, uint16_t size) {
  while (size--) put_byte(LINE, *data++);
}

bool board_stop_is_open(void) {
  static bool open;
  while (REGISTER(PINS + UART_STATE) & STATE_IN_FULL) {
    uint32_t command = REGISTER(PINS + UART_DATA);
    if (command == 'S' || command == 's') open = command == 'S';
  }
  return open;
}

uint16_t board_random_epoch(void) { return (uint16_t)(EPOCH + STARTS++); }
void board_feed_watchdog(void) { WATCHDOG_FEED = 1u; }
