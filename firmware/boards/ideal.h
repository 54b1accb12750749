/* What a board without pins gives to the ideal hardware of ideal.c. */
#ifndef FIRMWARE_IDEAL_H
#define FIRMWARE_IDEAL_H

#include "core/text.h"

/* Show a change of a pin; `format_pin` writes its line: microseconds, pin, value. */
void show_pin(const char *pin, double value);
void format_pin(struct text *text, const char *pin, double value);

#endif
