/* Ideal hardware for boards without pins: each change of a pin is shown by its name. */
#include "boards/ideal.h"

#include "boards/board.h"
#include "core/text.h"

#define HOME_MM 8.0
#define MARK_MM 0.05

static double jaws_mm = 8.3;
static double suction_mbar;
static bool shutter_open;

void format_pin(struct text *text, const char *pin, double value) {
  put_int(text, board_now_us());
  put_char(text, ' ');
  put_string(text, pin);
  put_char(text, ' ');
  put_real(text, value, 3);
  put_char(text, '\n');
}

void board_release_cameras(uint32_t mask) { show_pin("camera", (double)mask); }

bool board_set_led(uint16_t led, double level) {
  char pin[12];
  struct text text;
  text_start(&text, pin, sizeof pin);
  put_string(&text, "led");
  put_int(&text, led);
  if (level >= 0.0) show_pin(pin, level);
  return true;
}

bool board_pop(double power, uint16_t center_nm, uint16_t width_nm) {
  (void)center_nm, (void)width_nm;
  show_pin("pop", power);
  return true;
}

void board_turn(int32_t position) { show_pin("turn", (double)position); }
void board_start_jaws(double target_mm, bool back) { (void)target_mm, (void)back; }

bool board_drive_jaws(double distance_mm) {
  jaws_mm = distance_mm;
  return distance_mm > HOME_MM - MARK_MM && distance_mm < HOME_MM + MARK_MM;
}

void board_read_jaws(double *distance_mm, double *force_n) {
  *distance_mm = jaws_mm;
  *force_n = 0.0;
}

void board_hold_skin(bool hold) { show_pin("hold", hold); }

void board_move_shutter(bool open) {
  if (open != shutter_open) show_pin("shutter", open);
  shutter_open = open;
}

bool board_shutter_is(bool open) { return open == shutter_open; }

void board_set_suction(double mbar) {
  suction_mbar = mbar;
  show_pin("suction", mbar);
}

bool board_gauge_mbar(double *mbar) {
  *mbar = suction_mbar;
  return true;
}

double board_camera_c(void) { return 5.0; }
