/* What a board provides: 20 functions at most, and a box uses some of them.
 *
 * All are called from the main loop only, return at once, and act before they return.
 */
#ifndef FIRMWARE_BOARD_H
#define FIRMWARE_BOARD_H

#include <stdbool.h>
#include <stdint.h>

/* Every box. */
bool board_start(void);                               /* pins dark, clock and line on; true: memory
                                                         that survives a reset was lost */
int64_t board_now_us(void);                           /* since board_start, never backwards */
bool board_read(char *byte);                          /* next byte from the host, if any */
void board_send(const char *data, uint16_t size);     /* bytes to the host */
uint16_t board_random_epoch(void);                    /* another number after each reset */
void board_feed_watchdog(void);                       /* the hardware resets 0.1 s after the last */
bool board_stop_is_open(void);                        /* emergency stop contact */
void board_release_cameras(uint32_t mask);            /* pulse the lines of the mask's bits */

/* Lights, and the one stage that a box turns. */
bool board_set_led(uint16_t led, double level);       /* 0 to 1; false: it draws no current.
                                                         At 0 the answer is always true;
                                                         below 0: test, and do not drive it.
                                                         Modeling lamps are LED 0,
                                                         projectors their number. */
bool board_pop(double power, uint16_t center_nm, uint16_t width_nm); /* false: did not ignite */
void board_turn(int32_t position);                    /* analyzer, ring: 0.001 degrees; cover:
                                                         fiber, -1 for all; displays: 10000 times
                                                         the projector, plus 1000 and the number of
                                                         columns' stripes, or 2000 and of rows' */

/* Caliper. */
void board_start_jaws(double target_mm, bool back);   /* motor on; back: return, after a trip */
bool board_drive_jaws(double distance_mm);            /* true: they are at the home mark */
void board_read_jaws(double *distance_mm, double *force_n); /* encoder; NaN N: dead sensor */
void board_hold_skin(bool hold);                      /* clamps of the jaws; tare by the box */

/* Probe. */
void board_move_shutter(bool open);
bool board_shutter_is(bool open);                     /* the blades' sensor */
void board_set_suction(double mbar);                  /* 0: pump off, vent open */
bool board_gauge_mbar(double *mbar);                  /* false: the gauge draws no current */
double board_camera_c(void);                          /* degrees Celsius */

#endif
