/* Run an ATmega2560 image in simavr at the pace of the wall clock, its USART 0 on a pty.
 *
 * Usage: runner IMAGE.elf
 * It prints the terminal's name, then each edge of an output pin: cycles, port and pin, level.
 * Inputs are at rest: stop closed, nothing at fault. It ends when its standard input does.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <simavr/avr_ioport.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_elf.h>
#include <stdbool.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

#define HZ 16000000u
#define SLICE 16000u /* cycles between looks at the clock and the line */
#define BYTE_CYCLES 1389u /* ten bits at 115 200 Bd */

static FILE *out; /* simavr itself prints to stdout */
static avr_t *avr;
static int terminal;
static bool may_receive = true;

static void show_edge(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq;
  fprintf(out, "%llu %s %u\n", (unsigned long long)avr->cycle, (const char *)param, value);
  fflush(out);
}

static void sent(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)param;
  char byte = (char)value;
  if (write(terminal, &byte, 1) < 0) return; /* nobody reads */
}

static void xon(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)value, (void)param;
  may_receive = true;
}

static void xoff(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq, (void)value, (void)param;
  may_receive = false;
}

/* The chip sleeps: let time pass for it alone, this process has its own pace. */
static void sleep_callback(avr_t *of, avr_cycle_count_t cycles) { (void)of, (void)cycles; }

static void open_terminal(void) {
  struct termios raw;
  terminal = posix_openpt(O_RDWR | O_NOCTTY);
  if (terminal < 0 || grantpt(terminal) || unlockpt(terminal)) exit(1);
  int other = open(ptsname(terminal), O_RDWR | O_NOCTTY);
  if (other < 0 || tcgetattr(other, &raw)) exit(1);
  cfmakeraw(&raw);
  tcsetattr(other, TCSANOW, &raw);
  fcntl(terminal, F_SETFL, O_NONBLOCK);
  fprintf(out, "%s\n", ptsname(terminal));
  fflush(out);
}

static void watch_pins(void) {
  static char names[2][8][4];
  const char ports[2] = {'A', 'C'};
  for (int port = 0; port < 2; port++) {
    for (int pin = 0; pin < 8; pin++) {
      if (port == 1 && (pin == 0 || pin == 2)) continue; /* steps are too many to show */
      snprintf(names[port][pin], 4, "%c%d", ports[port], pin);
      avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(ports[port]), pin);
      avr_irq_register_notify(irq, show_edge, names[port][pin]);
    }
  }
  avr_ioport_external_t inputs = {.name = 'L', .mask = 0xFF, .value = 0xFE};
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('L'), &inputs);
  for (int pin = 0; pin < 8; pin++)
    avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('L'), pin), pin != 0);
}

static double wall_s(void) {
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  return (double)time.tv_sec + 1e-9 * (double)time.tv_nsec;
}

int main(int count, char **arguments) {
  elf_firmware_t image;
  out = fdopen(dup(STDOUT_FILENO), "w");
  dup2(STDERR_FILENO, STDOUT_FILENO);
  memset(&image, 0, sizeof image);
  if (count != 2 || elf_read_firmware(arguments[1], &image)) return 1;
  avr = avr_make_mcu_by_name("atmega2560");
  if (!avr) return 1;
  avr_init(avr);
  avr->frequency = HZ;
  avr->log = 0;
  avr_load_firmware(avr, &image);
  avr->frequency = HZ;
  avr->sleep = sleep_callback;
  uint32_t flags = 0;
  avr_ioctl(avr, AVR_IOCTL_UART_GET_FLAGS('0'), &flags);
  flags &= ~(uint32_t)(AVR_UART_FLAG_STDIO | AVR_UART_FLAG_POLL_SLEEP);
  avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
  avr_irq_t *input = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_INPUT);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUTPUT), sent, 0);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XON), xon, 0);
  avr_irq_register_notify(avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), UART_IRQ_OUT_XOFF), xoff,
                          0);
  open_terminal();
  watch_pins();
  double start = wall_s();
  avr_cycle_count_t next_byte = 0;
  for (;;) {
    avr_cycle_count_t until = avr->cycle + SLICE;
    while (avr->cycle < until) {
      int state = avr_run(avr);
      if (state == cpu_Done || state == cpu_Crashed) return 2;
      char byte;
      if (may_receive && avr->cycle >= next_byte && read(terminal, &byte, 1) == 1) {
        avr_raise_irq(input, (uint8_t)byte);
        next_byte = avr->cycle + BYTE_CYCLES;
      } else if (avr->cycle >= next_byte) {
        next_byte = avr->cycle + BYTE_CYCLES;
      }
    }
    struct pollfd end = {STDIN_FILENO, POLLIN, 0};
    if (poll(&end, 1, 0) > 0 && end.revents & (POLLHUP | POLLIN) &&
        read(STDIN_FILENO, &flags, 1) <= 0)
      return 0;
    double ahead = (double)avr->cycle / HZ - (wall_s() - start);
    if (ahead > 0.0) usleep((useconds_t)(1e6 * ahead));
    if (ahead < -1.0) start -= ahead; /* too slow a machine: do not run after lost time */
  }
}
