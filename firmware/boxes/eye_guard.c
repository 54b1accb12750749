/* Flicker at the eyes: flashes in the worst second, and the rms of 3 to 65 Hz. */
#include <math.h>

#include "boxes/led.h"

#define FUSION_S (1.0 / 65.0)
#define SAMPLE_S 2e-3
#define SECOND_SAMPLES 499 /* of a second, whose end is not in it */
#define MIN_FLASH_FRACTION 0.1
#define MIN_RMS_SPAN_S 2.0
#define TWO_PI 6.283185307179586

/* Switching times since `base` in s, with the change of light, and the light given until each. */
static struct {
  uint16_t count;
  bool full;
  us_t base, at[LIGHT_CHANGES];
  double step[LIGHT_CHANGES];
} change;

static void add_change(us_t at, double step) {
  uint16_t low = 0, high = change.count;
  while (low < high) {
    uint16_t middle = (uint16_t)((low + high) / 2);
    if (change.at[middle] < at)
      low = (uint16_t)(middle + 1);
    else
      high = middle;
  }
  if (low < change.count && change.at[low] == at) {
    change.step[low] += step;
    return;
  }
  if (change.count == LIGHT_CHANGES) {
    change.full = true;
    return;
  }
  for (uint16_t k = change.count++; k > low; k--) {
    change.at[k] = change.at[k - 1];
    change.step[k] = change.step[k - 1];
  }
  change.at[low] = at;
  change.step[low] = step;
}

static void add_pulse(const struct pulse *pulse, void *context) {
  (void)context;
  double step = LED_EYE_WEIGHT[pulse->led] * pulse->level;
  add_change(pulse->on, step);
  add_change(pulse->off, -step);
}

bool guard_is_full(void) { return change.full; }

static double time_s(uint16_t k) { return seconds_of(change.at[k] - change.base); }

/* The light given until a time, interpolated; `place` follows rising times. */
static double light_until(double at_s, uint16_t *place) {
  uint16_t last = (uint16_t)(change.count - 1);
  if (at_s <= time_s(0)) return change.step[0];
  if (at_s >= time_s(last)) return change.step[last];
  while (time_s((uint16_t)(*place + 1)) <= at_s) ++*place;
  double from = time_s(*place);
  double slope = (change.step[*place + 1] - change.step[*place]) /
                 (time_s((uint16_t)(*place + 1)) - from);
  return slope * (at_s - from) + change.step[*place];
}

/* The light that the eye perceives: averaged over the fusion time. */
static double seen(uint32_t sample, double start_s, uint16_t places[2]) {
  double at_s = start_s + sample * SAMPLE_S;
  double upper = light_until(at_s + 0.5 * FUSION_S, &places[0]);
  return (upper - light_until(at_s - 0.5 * FUSION_S, &places[1])) / FUSION_S;
}

/* Largest number of turns in any second, from the samples of the turns as they come. */
static struct {
  uint32_t at[SECOND_SAMPLES + 1];
  uint16_t first, count, most;
} turns;

static void add_turn(uint32_t sample) {
  while (turns.count && sample - turns.at[turns.first] > SECOND_SAMPLES) {
    turns.first = (uint16_t)((turns.first + 1) % (SECOND_SAMPLES + 1));
    turns.count--;
  }
  turns.at[(turns.first + turns.count++) % (SECOND_SAMPLES + 1)] = sample;
  if (turns.count > turns.most) turns.most = turns.count;
}

/* Half the reversals by a tenth of the brightest light, in the worst second. */
double guard_flashes_per_s(requested_light *past, requested_light *light) {
  change.count = 0;
  change.full = false;
  past(-1, add_pulse, NULL);
  light(-1, add_pulse, NULL);
  if (change.count == 0 || change.full) return 0.0;
  change.base = core_now();
  double rate = 0.0, total = 0.0;
  for (uint16_t k = 0; k < change.count; k++) {
    if (k) total += rate * (time_s(k) - time_s((uint16_t)(k - 1)));
    rate += change.step[k];
    change.step[k] = total;
  }
  double start_s = time_s(0) - 0.1, stop_s = time_s((uint16_t)(change.count - 1)) + 0.1;
  uint32_t samples = (uint32_t)ceil((stop_s - start_s) / SAMPLE_S);
  uint16_t places[2] = {0, 0};
  double most = 0.0;
  for (uint32_t k = 0; k < samples; k++) {
    bank_keep_ends();
    double value = seen(k, start_s, places);
    if (value > most) most = value;
  }
  if (most <= 0.0) return 0.0;
  double least = MIN_FLASH_FRACTION * most;
  places[0] = places[1] = 0;
  double low = seen(0, start_s, places), high = low;
  int8_t direction = 0;
  turns.first = turns.count = turns.most = 0;
  for (uint32_t k = 0; k < samples; k++) {
    bank_keep_ends();
    double value = seen(k, start_s, places);
    if (value < low) low = value;
    if (value > high) high = value;
    if (direction <= 0 && value >= low + least) {
      direction = 1;
      high = value;
      add_turn(k);
    } else if (direction >= 0 && value <= high - least) {
      direction = -1;
      low = value;
      add_turn(k);
    }
    if (direction > 0) low = high;
    if (direction < 0) high = low;
  }
  return turns.most / 2.0;
}

/* Intervals of light; LEDs that are lit together add up to one light at the eye. */
static struct {
  uint16_t count;
  us_t on[LIGHT_CHANGES], off[LIGHT_CHANGES];
  double light[LIGHT_CHANGES];
} interval;

static void add_interval(const struct pulse *pulse, void *context) {
  (void)context;
  if (pulse->off <= pulse->on) return;
  double light = LED_EYE_WEIGHT[pulse->led] * pulse->level;
  /* equal intervals come close to each other */
  for (uint16_t k = interval.count; k && k + 200 > interval.count; k--) {
    if (interval.on[k - 1] == pulse->on && interval.off[k - 1] == pulse->off) {
      interval.light[k - 1] += light;
      return;
    }
  }
  if (interval.count == LIGHT_CHANGES) {
    change.full = true;
    return;
  }
  interval.on[interval.count] = pulse->on;
  interval.off[interval.count] = pulse->off;
  interval.light[interval.count++] = light;
}

/* The rms of the 3 to 65 Hz part over the mean, from first light to last. */
double guard_rms(requested_light *light) {
  interval.count = 0;
  light(-1, add_interval, NULL);
  if (interval.count == 0) return 0.0;
  us_t start = interval.on[0], end = interval.off[0];
  for (uint16_t k = 1; k < interval.count; k++) {
    start = sooner(start, interval.on[k]);
    end = later(end, interval.off[k]);
  }
  double span = seconds_of(end - start), mean = 0.0, power = 0.0;
  for (uint16_t k = 0; k < interval.count; k++)
    mean += interval.light[k] * seconds_of(interval.off[k] - interval.on[k]);
  mean /= span;
  if (span < MIN_RMS_SPAN_S || mean <= 0.0) return 0.0;
  /* by Parseval the band's mean square is twice the sum of |c_n|^2 over positive orders; a
     pulse's coefficient is (exp(-i w off) - exp(-i w on)) / (-i w span) */
  for (uint32_t order = (uint32_t)ceil(3.0 * span); order <= (uint32_t)(65.0 * span); order++) {
    double omega = TWO_PI * order / span, real = 0.0, imaginary = 0.0;
    bank_keep_ends();
    for (uint16_t k = 0; k < interval.count; k++) {
      double off = omega * seconds_of(interval.off[k] - start);
      double on = omega * seconds_of(interval.on[k] - start);
      real += interval.light[k] * (cos(off) - cos(on));
      imaginary -= interval.light[k] * (sin(off) - sin(on));
    }
    double size = omega * span;
    power += (real * real + imaginary * imaginary) / (size * size);
  }
  return sqrt(2.0 * power) / mean;
}
