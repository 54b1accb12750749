/* The board `posix`: a process on a pseudo-terminal or a TCP port, with ideal hardware at its pins.
 *
 * With FIRMWARE_TCP=PORT in the environment it listens on this machine, on a free port if that is 0;
 * one host at a time. It prints its URL, and then each change of a pin: microseconds, pin, value.
 * S and s on the standard input open and close the emergency stop.
 */
#define _XOPEN_SOURCE 600
#include "boards/board.h"
#include "boards/ideal.h"

#include <arpa/inet.h>
#include <fcntl.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/socket.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

static int line = -1, listener = -1; /* of a host; -1: none */

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

static void listen_on(const char *port) {
  struct sockaddr_in place = {.sin_family = AF_INET, .sin_port = htons((uint16_t)atoi(port))};
  socklen_t size = sizeof place;
  int on = 1;
  place.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  listener = socket(AF_INET, SOCK_STREAM, 0);
  if (listener < 0) exit(1);
  setsockopt(listener, SOL_SOCKET, SO_REUSEADDR, &on, sizeof on);
  if (bind(listener, (struct sockaddr *)&place, size) || listen(listener, 1) ||
      getsockname(listener, (struct sockaddr *)&place, &size))
    exit(1);
  printf("socket://127.0.0.1:%u\n", ntohs(place.sin_port));
}

static void accept_host(void) {
  int on = 1;
  line = accept(listener, NULL, NULL);
  if (line >= 0) setsockopt(line, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
}

static void open_terminal(void) {
  struct termios raw;
  line = posix_openpt(O_RDWR | O_NOCTTY);
  if (line < 0 || grantpt(line) || unlockpt(line)) exit(1);
  const char *name = ptsname(line);
  int other = open(name, O_RDWR | O_NOCTTY); /* kept open: a host that leaves is no error */
  if (other < 0 || tcgetattr(other, &raw)) exit(1);
  raw.c_iflag = raw.c_oflag = raw.c_lflag = 0;
  raw.c_cflag |= CS8;
  tcsetattr(other, TCSANOW, &raw);
  fcntl(line, F_SETFL, O_NONBLOCK);
  printf("%s\n", name);
}

bool board_start(void) {
  const char *port = getenv("FIRMWARE_TCP");
  signal(SIGPIPE, SIG_IGN);
  if (port)
    listen_on(port);
  else
    open_terminal();
  fflush(stdout);
  return true;
}

bool board_read(char *byte) {
  struct pollfd wait = {line < 0 ? listener : line, POLLIN, 0};
  if (poll(&wait, 1, 1) <= 0) return false;
  if (line < 0) {
    accept_host();
    return false;
  }
  if (read(line, byte, 1) == 1) return true;
  if (listener >= 0) { /* the host has left */
    close(line);
    line = -1;
  }
  return false;
}

void board_send(const char *data, uint16_t size) {
  while (size) {
    ssize_t sent = line < 0 ? -1 : write(line, data, size);
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

bool board_stop_is_open(void) {
  static bool open;
  struct pollfd wait = {STDIN_FILENO, POLLIN, 0};
  char command;
  while (poll(&wait, 1, 0) > 0 && read(STDIN_FILENO, &command, 1) == 1)
    if (command == 'S' || command == 's') open = command == 'S';
  return open;
}

void board_feed_watchdog(void) {}
