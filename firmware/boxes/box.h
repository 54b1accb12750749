/* What the files of boxes share. */
#ifndef FIRMWARE_BOX_H
#define FIRMWARE_BOX_H

#include "boards/board.h"
#include "core/core.h"
#include "limits.h"

#define COMMAND(name) enum code name(char *arguments, struct text *answer)
#define UNUSED (void)arguments, (void)answer
/* Return the refusal of an expression, if it is one. */
#define TRY(expression)                       \
  do {                                        \
    enum code code_ = (expression);           \
    if (code_ != CODE_OK) return code_;       \
  } while (0)
#define HEAT_TOLERANCE 1e-6
#define READING_MAX_MDEG 180000

static inline us_t later(us_t a, us_t b) { return a > b ? a : b; }
static inline us_t sooner(us_t a, us_t b) { return a < b ? a : b; }

#ifdef QUARTER_TURN_US
/* How long a rotation by an angle takes. */
static inline us_t rotation_us(int32_t from_mdeg, int32_t to_mdeg) {
  int64_t angle = to_mdeg > from_mdeg ? to_mdeg - from_mdeg : from_mdeg - to_mdeg;
  return (2 * angle * QUARTER_TURN_US + 90000) / 180000;
}
#endif

#endif
