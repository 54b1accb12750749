/* The board `posix`: a process on a pseudo-terminal, with ideal hardware at its pins.
 *
 * It prints the terminal's name, and then each change of a pin: microseconds, pin, value.
 */
#define _XOPEN_SOURCE 600
#include "boards/board.h"
#include "boards/ideal.h"

#include <fcntl.h>
#include <poll.h>
#include <stdio.h>
#include <stdlib.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static int terminal;

void show_pin(const char *pin, double value) {
  char data[64];
  struct text text;
  text_start(&text, data, sizeof data);
  format_pin(&text, pin, value);
  fputs(data, stdout);
  fflush(stdout);
}

int64_t board_now_us(void) {
  static int64_t start;
  struct timespec time;
  clock_gettime(CLOCK_MONOTONIC, &time);
  int64_t now = (int64_t)time.tv_sec * 1000000 + time.tv_nsec / 1000;
  if (!start) start = now;
  return now - start;
}

bool board_start(void) {
  struct termios raw;
  terminal = posix_openpt(O_RDWR | O_NOCTTY);
  if (terminal < 0 || grantpt(terminal) || unlockpt(terminal)) exit(1);
  const char *name = ptsname(terminal);
  int other = open(name, O_RDWR | O_NOCTTY); /* kept open: a host that leaves is no error */
  if (other < 0 || tcgetattr(other, &raw)) exit(1);
  raw.c_iflag = raw.c_oflag = raw.c_lflag = 0;
  raw.c_cflag |= CS8;
  tcsetattr(other, TCSANOW, &raw);
  fcntl(terminal, F_SETFL, O_NONBLOCK);
  printf("%s\n", name);
  fflush(stdout);
  return true;
}

bool board_read(char *byte) {
  struct pollfd wait = {terminal, POLLIN, 0};
  if (poll(&wait, 1, 1) <= 0) return false;
  return read(terminal, byte, 1) == 1;
}

void board_send(const char *data, uint16_t size) {
  while (size) {
    ssize_t sent = write(terminal, data, size);
    if (sent <= 0) return; /* nobody reads: lost, as on a real line */
    data += sent;
    size = (uint16_t)(size - sent);
  }
}

uint16_t board_random_epoch(void) {
  uint16_t epoch = 0;
  int source = open("/dev/urandom", O_RDONLY);
  if (source < 0 || read(source, &epoch, 2) != 2) exit(1);
  close(source);
  return epoch;
}

void board_feed_watchdog(void) {}
