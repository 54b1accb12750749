/* The main loop of every board. */
#include "boards/board.h"
#include "core/core.h"

int main(void) {
  bool cold = board_start();
  core_power_up(board_now_us(), cold);
  core_announce(board_now_us());
  for (;;) {
    char byte;
    board_feed_watchdog();
    while (board_read(&byte)) core_feed(&byte, 1, board_now_us());
    core_advance(board_now_us());
  }
}
