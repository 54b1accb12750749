/* Limits of the caliper box of rig 'gradient'.
 * Made by tools/make_firmware_limits.py. */
#ifndef FIRMWARE_LIMITS_H
#define FIRMWARE_LIMITS_H

#include "core/text.h"

#define BOX_KIND "caliper"
#define BOX_MODEL "CALIPER1"
#ifndef BOX_SERIAL
#define BOX_SERIAL "CA-0001"
#endif
#define BOX_FIRMWARE "1.0"
#define BOX_PROTOCOL "1"
#define BOX_CAPABILITIES "{\"kind\":\"caliper\",\"protocol\":1,\"protocol_minor\":3,\"lease_min_ms\":300,\"lease_max_ms\":5000,\"step_min\":-4,\"step_max\":8,\"step_mm\":0.8,\"aperture_mm\":8.0,\"angles_deg\":[0.0,45.0,90.0,135.0],\"speed_mm_per_s\":2.0,\"turn_deg_per_s\":90.0,\"force_limit_min_n\":0.05,\"force_limit_max_n\":10.0,\"control_period_ms\":5.0}"

#define STEP_MIN (-4)
#define STEP_MAX 8
#define STEP_MM 0.8
#define APERTURE_MM 8.0
#define SPEED_MM_PER_S 2.0
#define TRAVEL_LOW_MM 4.3999999999999995
#define TRAVEL_HIGH_MM 14.8
static const FLASH int32_t ANGLES_MDEG[] = {0, 45000, 90000, 135000};
#define ANGLE_COUNT 4

/* X(handler, header, arguments, needs, arguments that make dark) */
#define BOX_COMMANDS(X) \
  X(get_idn, "*IDN?", "", 0, "") \
  X(do_rst, "*RST", "", 0, "") \
  X(do_cls, "*CLS", "", BARE, "") \
  X(get_opc, "*OPC?", "", 0, "") \
  X(get_syst_err, "SYST:ERR?", "", 0, "") \
  X(get_syst_hello, "SYST:HELLO?", "", 0, "") \
  X(get_syst_cap, "SYST:CAP?", "", 0, "") \
  X(get_syst_cap_part, "SYST:CAP:PART?", "<n>", 0, "") \
  X(do_syst_wdog, "SYST:WDOG", "<ms>", 0, "") \
  X(get_syst_wdog, "SYST:WDOG?", "", 0, "") \
  X(do_syst_arm, "SYST:ARM", "", 0, "") \
  X(get_syst_arm, "SYST:ARM?", "", 0, "") \
  X(get_syst_ping, "SYST:PING?", "", 0, "") \
  X(do_safe, "SAFE", "", BARE, "") \
  X(do_abor, "ABOR", "", BARE, "") \
  X(get_stat, "STAT?", "", 0, "") \
  X(do_cal_home, "CAL:HOME", "", ARMED, "") \
  X(do_cal_step_abs, "CAL:STEP:ABS", "<n>", ARMED, "") \
  X(get_cal_pos, "CAL:POS?", "", 0, "") \
  X(get_cal_last, "CAL:LAST?", "", 0, "") \
  X(do_cal_ang, "CAL:ANG", "<deg>", ARMED, "") \
  X(get_cal_ang, "CAL:ANG?", "", 0, "") \
  X(do_cal_att, "CAL:ATT", "", ARMED, "") \
  X(get_cal_att, "CAL:ATT?", "", 0, "") \
  X(do_cal_rel, "CAL:REL", "", BARE, "") \
  X(get_cal_forc, "CAL:FORC?", "", 0, "") \
  X(do_cal_forc_lim, "CAL:FORC:LIM", "<N>", 0, "") \
  X(get_cal_forc_lim, "CAL:FORC:LIM?", "", 0, "")

#endif
