/* Text of commands and answers: bounded output and exact decimals. No heap, no stdio. */
#ifndef FIRMWARE_TEXT_H
#define FIRMWARE_TEXT_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Constant text; on AVR it stays in flash memory. */
#ifdef __AVR__
#define FLASH __flash
#define P(string) (__extension__({ static const FLASH char text_[] = string; &text_[0]; }))
#else
#define FLASH
#define P(string) (string)
#endif
typedef const FLASH char *flash_text;

#define NANO INT64_C(1000000000)

/* Output of a fixed size: what does not fit is dropped, and `data` stays a string. */
struct text {
  char *data;
  uint16_t size;
  uint16_t used;
};

void text_start(struct text *text, char *data, uint16_t size);
void put_char(struct text *text, char character);
void put_flash(struct text *text, flash_text string);
void put_string(struct text *text, const char *string);
void put_int(struct text *text, int64_t value);
void put_hex(struct text *text, uint32_t value, uint8_t digits, bool upper);
/* value / 10^digits with exactly `digits` decimals. */
void put_fixed(struct text *text, int64_t value, uint8_t digits);
/* value / 10^digits without zeros at the end, at most six significant digits (C's %g). */
void put_general(struct text *text, int64_t value, uint8_t digits);
/* A float with `digits` decimals, rounded as C's printf does. */
void put_real(struct text *text, double value, uint8_t digits);

/* value times 10^digits, rounded to the nearest whole number. */
int64_t scaled(double value, uint8_t digits);

char upper(char character);
bool is_digit(char character);
/* Whether a text is `word`, whatever its case. */
bool equals_word(const char *text, flash_text word);
/* Cut `text` at its first `mark`; return the rest, or NULL without a mark. */
char *cut(char *text, char mark);
uint8_t hex_digit(char character); /* 16: none */

/* Numbers as the protocol spells them, in units of 10^-9; false: not one. */
bool parse_nano(const char *text, int64_t *nano);
/* 1 to `most` decimal digits. */
bool parse_digits(const char *text, uint8_t most, uint32_t *value);
/* 1 to 8 hexadecimal digits. */
bool parse_hex(const char *text, uint32_t *value);
/* Nano-units to units of 10^-digits, halves rounded up. */
int64_t round_nano(int64_t nano, uint8_t digits);
/* Floor of a quotient, divisor > 0. */
int64_t floor_divide(int64_t value, int64_t divisor);

uint16_t crc16(uint16_t crc, const char *data, uint16_t size);
uint32_t hash32(const char *string);

#endif
