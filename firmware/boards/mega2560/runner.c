/* Run an ATmega2560 image in simavr at the pace of the wall clock, its USART 0 on a pty.
 *
 * Usage: runner IMAGE.elf [EEPROM]
 * It prints the terminal's name, then each edge of an output pin: cycles, port and pin, level.
 * The hardware behind the pins is ideal: stop closed, nothing at fault, jaws that follow their
 * steps with skin of 0.1 N/mm, a pump, blades. The EEPROM's file outlives the process. Commands on
 * the standard input, one letter each: b brown-out, S and s stop open and closed, j and J jaws stuck
 * and free, g bytes of memory that no stack has reached. The runner ends when its input does.
 */
#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <math.h>
#include <simavr/avr_adc.h>
#include <simavr/avr_eeprom.h>
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

/* hardware behind the pins */
#define MM_PER_STEP 0.0025
#define HOME_MM 8.0
#define MARK_MM 0.05
#define STIFFNESS_N_PER_MM 0.1
#define PUMP_TAU_S 0.1
#define CAMERA_C 5.0
#define OCR4B_LOW 0xAA /* suction that the regulator keeps, mbar */
#define UNTOUCHED 0xC5
static double jaws_mm = 8.3, held_mm, suction_mbar;
static bool jaws_stuck, is_held, pump_on, vent_closed;
static int jaws_direction = 1;

static void show_edge(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq;
  fprintf(out, "%llu %s %u\n", (unsigned long long)avr->cycle, (const char *)param, value);
  fflush(out);
}

static void set_input(int pin, bool high) {
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ('L'), pin), high);
}

static void set_mv(int channel, double mv) {
  avr_raise_irq(avr_io_getirq(avr, AVR_IOCTL_ADC_GETIRQ, channel), (uint32_t)(mv + 0.5));
}

static void show_loads(void) {
  double force_n = is_held ? STIFFNESS_N_PER_MM * (jaws_mm - held_mm) : 0.0;
  set_mv(ADC_IRQ_ADC0, 2500.0 + 250.0 * force_n + 2.0);
  set_mv(ADC_IRQ_ADC1, 500.0 + 4000.0 * suction_mbar / 250.0);
  set_mv(ADC_IRQ_ADC2, 10.0 * (CAMERA_C + 50.0) + 2.0);
  set_mv(ADC_IRQ_ADC3, jaws_mm * 5000.0 / 20.48 + 2.0);
  set_input(3, fabs(jaws_mm - HOME_MM) > MARK_MM);
}

static void move_load(struct avr_irq_t *irq, uint32_t value, void *param) {
  (void)irq;
  switch ((int)(intptr_t)param) {
    case 2: /* step of the jaws */
      if (value && !jaws_stuck) jaws_mm += jaws_direction * MM_PER_STEP;
      break;
    case 3: jaws_direction = value ? 1 : -1; break;
    case 14: set_input(4, !value); break; /* blades */
    case 15: pump_on = value; break;
    case 16: vent_closed = value; break;
    case 17:
      is_held = value;
      held_mm = jaws_mm;
      break;
    default: return;
  }
  show_loads();
}

/* Power fails: the processor stops, memory is lost, the EEPROM stays. */
static void brown_out(void) {
  avr_reset(avr);
  for (uint32_t k = avr->ioend + 1u; k <= avr->ramend; k++)
    avr->data[k] = (uint8_t)(k * 167u + avr->cycle);
  avr_regbit_set(avr, avr->reset_flags.borf);
  avr_regbit_clear(avr, avr->reset_flags.porf);
}

static void show_untouched(void) {
  uint32_t most = 0, run = 0;
  for (uint32_t k = avr->ioend + 1u; k <= avr->ramend; k++) {
    run = avr->data[k] == UNTOUCHED ? run + 1u : 0;
    if (run > most) most = run;
  }
  fprintf(out, "%llu untouched %u\n", (unsigned long long)avr->cycle, most);
  fflush(out);
}

static void obey(char command) {
  if (command == 'b') brown_out();
  if (command == 'S' || command == 's') set_input(0, command == 'S');
  if (command == 'j' || command == 'J') jaws_stuck = command == 'j';
  if (command == 'g') show_untouched();
}

/* Read (write: false) or write the EEPROM's file. */
static void keep_eeprom(const char *path, bool write) {
  static uint8_t bytes[4096];
  avr_eeprom_desc_t all = {.ee = bytes, .offset = 0, .size = sizeof bytes};
  FILE *file = path ? fopen(path, write ? "wb" : "rb") : NULL;
  if (!file) return;
  if (write) {
    avr_ioctl(avr, AVR_IOCTL_EEPROM_GET, &all);
    fwrite(bytes, 1, sizeof bytes, file);
  } else if (fread(bytes, 1, sizeof bytes, file) == sizeof bytes) {
    avr_ioctl(avr, AVR_IOCTL_EEPROM_SET, &all);
  }
  fclose(file);
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
      avr_irq_t *irq = avr_io_getirq(avr, AVR_IOCTL_IOPORT_GETIRQ(ports[port]), pin);
      intptr_t number = port == 0 ? 10 + pin : pin;
      avr_irq_register_notify(irq, move_load, (void *)number);
      if (port == 1 && (pin == 0 || pin == 2)) continue; /* steps are too many to show */
      snprintf(names[port][pin], 4, "%c%d", ports[port], pin);
      avr_irq_register_notify(irq, show_edge, names[port][pin]);
    }
  }
  avr_ioport_external_t inputs = {.name = 'L', .mask = 0xFF, .value = 0xFE};
  avr_ioctl(avr, AVR_IOCTL_IOPORT_SET_EXTERNAL('L'), &inputs);
  for (int pin = 0; pin < 8; pin++) set_input(pin, pin != 0);
  show_loads();
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
  if (count < 2 || count > 3 || elf_read_firmware(arguments[1], &image)) return 1;
  avr = avr_make_mcu_by_name("atmega2560");
  if (!avr) return 1;
  avr_init(avr);
  avr->frequency = HZ;
  avr->log = 0;
  avr_load_firmware(avr, &image);
  avr->frequency = HZ;
  avr->sleep = sleep_callback;
  avr->vcc = avr->avcc = avr->aref = 5000;
  memset(avr->data + avr->ioend + 1, UNTOUCHED, avr->ramend - avr->ioend);
  keep_eeprom(arguments[2], false);
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
    double wanted_mbar = pump_on && vent_closed ? avr->data[OCR4B_LOW] : 0.0;
    suction_mbar += (wanted_mbar - suction_mbar) * ((double)SLICE / HZ / PUMP_TAU_S);
    show_loads();
    struct pollfd end = {STDIN_FILENO, POLLIN, 0};
    if (poll(&end, 1, 0) > 0) {
      char command;
      if (read(STDIN_FILENO, &command, 1) <= 0) {
        keep_eeprom(arguments[2], true);
        return 0;
      }
      obey(command);
    }
    double ahead = (double)avr->cycle / HZ - (wall_s() - start);
    if (ahead > 0.0) usleep((useconds_t)(1e6 * ahead));
    if (ahead < -1.0) start -= ahead; /* too slow a machine: do not run after lost time */
  }
}
