/* The board `host` as a shared library: a test host calls the core and answers its board calls.
 *
 * All state of the core lies in one section, so that one library serves many boxes in turn.
 */
#include "boards/board.h"
#include "core/core.h"

struct host_board {
  void (*send)(const char *data, uint16_t size);
  uint16_t (*random_epoch)(void);
  bool (*stop_is_open)(void);
  void (*release_cameras)(uint32_t mask);
  bool (*set_led)(uint16_t led, double level);
  bool (*pop)(double power, uint16_t center_nm, uint16_t width_nm);
  void (*turn)(int32_t position);
  void (*start_jaws)(double target_mm, bool back);
  bool (*drive_jaws)(double distance_mm);
  void (*read_jaws)(double *distance_mm, double *force_n);
  void (*hold_skin)(bool hold);
  void (*move_shutter)(bool open);
  bool (*shutter_is)(bool open);
  void (*set_suction)(double mbar);
  bool (*gauge_mbar)(double *mbar);
  double (*camera_c)(void);
};

static struct host_board board;
extern char __start_firmware_state[], __stop_firmware_state[];

/* For the test host. */
void host_connect(const struct host_board *calls);
char *host_state(void);
uint32_t host_state_size(void);
int64_t host_now(void);
int64_t host_deadline(void);
void host_power_up(int64_t now, bool cold);
void host_announce(int64_t now);
void host_feed(const char *data, uint16_t size, int64_t now);
void host_advance(int64_t now);
void host_query(char *line, uint16_t size);
void host_hello(char *line, uint16_t size);

void host_connect(const struct host_board *calls) { board = *calls; }
char *host_state(void) { return __start_firmware_state; }
uint32_t host_state_size(void) {
  return (uint32_t)(__stop_firmware_state - __start_firmware_state);
}
int64_t host_now(void) { return core_now(); }
int64_t host_deadline(void) { return core_deadline(); }
void host_power_up(int64_t now, bool cold) { core_power_up(now, cold); }
void host_announce(int64_t now) { core_announce(now); }
void host_feed(const char *data, uint16_t size, int64_t now) { core_feed(data, size, now); }
void host_advance(int64_t now) { core_advance(now); }
void host_query(char *line, uint16_t size) {
  core_ask(core_handle_bare_line, line, size);
}
void host_hello(char *line, uint16_t size) {
  core_ask(core_handle_framed_line, line, size);
}

void board_feed_watchdog(void) {}
int64_t board_now_us(void) { return core_now(); }
void board_send(const char *data, uint16_t size) { board.send(data, size); }
uint16_t board_random_epoch(void) { return board.random_epoch(); }
bool board_stop_is_open(void) { return board.stop_is_open(); }
void board_release_cameras(uint32_t mask) { board.release_cameras(mask); }
bool board_set_led(uint16_t led, double level) { return board.set_led(led, level); }
bool board_pop(double power, uint16_t center_nm, uint16_t width_nm) {
  return board.pop(power, center_nm, width_nm);
}
void board_turn(int32_t position) { board.turn(position); }
void board_start_jaws(double target_mm, bool back) { board.start_jaws(target_mm, back); }
bool board_drive_jaws(double distance_mm) { return board.drive_jaws(distance_mm); }
void board_read_jaws(double *distance_mm, double *force_n) {
  board.read_jaws(distance_mm, force_n);
}
void board_hold_skin(bool hold) { board.hold_skin(hold); }
void board_move_shutter(bool open) { board.move_shutter(open); }
bool board_shutter_is(bool open) { return board.shutter_is(open); }
void board_set_suction(double mbar) { board.set_suction(mbar); }
bool board_gauge_mbar(double *mbar) { return board.gauge_mbar(mbar); }
double board_camera_c(void) { return board.camera_c(); }
