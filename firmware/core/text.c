#include "core/text.h"

#include <math.h>

void text_start(struct text *text, char *data, uint16_t size) {
  text->data = data;
  text->size = size;
  text->used = 0;
  data[0] = '\0';
}

void put_char(struct text *text, char character) {
  if (text->used + 1u < text->size) {
    text->data[text->used++] = character;
    text->data[text->used] = '\0';
  }
}

void put_flash(struct text *text, flash_text string) {
  while (*string) put_char(text, *string++);
}

void put_string(struct text *text, const char *string) {
  while (*string) put_char(text, *string++);
}

void put_fixed(struct text *text, int64_t value, uint8_t digits) {
  char reversed[24];
  uint8_t count = 0;
  uint64_t rest = value < 0 ? 0u - (uint64_t)value : (uint64_t)value;
  if (value < 0) put_char(text, '-');
  do {
    if (digits && count == digits) reversed[count++] = '.';
    reversed[count++] = (char)('0' + (char)(rest % 10u));
    rest /= 10u;
  } while (rest || count <= digits);
  while (count) put_char(text, reversed[--count]);
}

void put_int(struct text *text, int64_t value) { put_fixed(text, value, 0); }

void put_hex(struct text *text, uint32_t value, uint8_t digits, bool capital) {
  while (digits < 8 && value >> (4 * digits)) digits++;
  while (digits) {
    uint8_t digit = (uint8_t)(value >> (4 * --digits) & 15u);
    put_char(text, (char)(digit < 10 ? '0' + digit : (capital ? 'A' : 'a') + digit - 10));
  }
}

void put_general(struct text *text, int64_t value, uint8_t digits) {
  int64_t size = value < 0 ? -value : value;
  int64_t step = 1;
  while (size / step >= 1000000) step *= 10;
  /* to six significant digits, halves to the even one */
  int64_t low = size / step, rest = size % step;
  if (2 * rest > step || (2 * rest == step && low % 2)) low++;
  size = low * step;
  while (digits && size % 10 == 0) {
    size /= 10;
    digits--;
  }
  put_fixed(text, value < 0 ? -size : size, digits);
}

int64_t scaled(double value, uint8_t digits) {
  double factor = 1.0;
  while (digits--) factor *= 10.0;
  double product = value * factor;
  double whole = floor(product);
  double part = product - whole;
#ifndef __AVR__
  /* where the product looks like a half, its own rounding error decides */
  if (part == 0.5) {
    double error = fma(value, factor, -product);
    if (error != 0.0) return (int64_t)whole + (error > 0.0);
  }
#endif
  int64_t low = (int64_t)whole;
  return low + (part > 0.5 || (part == 0.5 && low % 2));
}

void put_real(struct text *text, double value, uint8_t digits) {
  int64_t units = scaled(value, digits);
  if (units == 0 && value < 0.0) put_char(text, '-');
  put_fixed(text, units, digits);
}

char upper(char character) {
  return character >= 'a' && character <= 'z' ? (char)(character - 32) : character;
}

bool is_digit(char character) { return character >= '0' && character <= '9'; }

bool equals_word(const char *text, flash_text word) {
  while (*text && upper(*text) == *word) {
    text++;
    word++;
  }
  return !*text && !*word;
}

char *cut(char *text, char mark) {
  while (*text && *text != mark) text++;
  if (!*text) return NULL;
  *text = '\0';
  return text + 1;
}

uint8_t hex_digit(char character) {
  if (is_digit(character)) return (uint8_t)(character - '0');
  character = upper(character);
  return character >= 'A' && character <= 'F' ? (uint8_t)(character - 'A' + 10) : 16;
}

bool parse_nano(const char *text, int64_t *nano) {
  bool negative = *text == '-';
  if (negative) text++;
  int64_t value = 0;
  uint8_t count = 0;
  for (; is_digit(*text); text++, count++) {
    if (count == 9) return false;
    value = 10 * value + (*text - '0');
  }
  if (count == 0) return false;
  uint8_t decimals = 0;
  if (*text == '.') {
    for (text++; is_digit(*text); text++, decimals++) {
      if (decimals == 9) return false;
      value = 10 * value + (*text - '0');
    }
    if (decimals == 0) return false;
  }
  if (*text) return false;
  while (decimals++ < 9) value *= 10;
  *nano = negative ? -value : value;
  return true;
}

bool parse_digits(const char *text, uint8_t most, uint32_t *value) {
  uint8_t count = 0;
  *value = 0;
  for (; is_digit(*text); text++, count++) {
    if (count == most) return false;
    *value = 10u * *value + (uint32_t)(*text - '0');
  }
  return count > 0 && !*text;
}

bool parse_hex(const char *text, uint32_t *value) {
  uint8_t count = 0;
  *value = 0;
  for (; hex_digit(*text) < 16; text++, count++) {
    if (count == 8) return false;
    *value = *value << 4 | hex_digit(*text);
  }
  return count > 0 && !*text;
}

int64_t floor_divide(int64_t value, int64_t divisor) {
  return value / divisor - (value % divisor < 0);
}

int64_t round_nano(int64_t nano, uint8_t digits) {
  int64_t unit = NANO;
  while (digits--) unit /= 10;
  return floor_divide(2 * nano + unit, 2 * unit);
}

uint16_t crc16(uint16_t crc, const char *data, uint16_t size) {
  while (size--) {
    crc = (uint16_t)(crc ^ (uint16_t)((uint8_t)*data++ << 8));
    for (uint8_t bit = 0; bit < 8; bit++)
      crc = (uint16_t)(crc & 0x8000u ? (uint32_t)crc << 1 ^ 0x1021u : (uint32_t)crc << 1);
  }
  return crc;
}

uint32_t hash32(const char *string) { /* FNV-1a */
  uint32_t hash = 2166136261u;
  while (*string) hash = (hash ^ (uint8_t)*string++) * 16777619u;
  return hash;
}
