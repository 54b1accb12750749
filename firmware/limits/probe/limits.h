/* Limits of the probe box of rig 'probe'.
 * Made by tools/make_firmware_limits.py. */
#ifndef FIRMWARE_LIMITS_H
#define FIRMWARE_LIMITS_H

#include "core/text.h"

#define BOX_KIND "probe"
#define BOX_MODEL "PROBE1"
#ifndef BOX_SERIAL
#define BOX_SERIAL "PR-0001"
#endif
#define BOX_FIRMWARE "1.0"
#define BOX_PROTOCOL "1"
#define BOX_CAPABILITIES "{\"kind\":\"probe\",\"protocol\":1,\"protocol_minor\":3,\"lease_min_ms\":300,\"lease_max_ms\":5000,\"fibres\":28,\"level_steps\":1000,\"shutter_min_ms\":1.0,\"shutter_max_ms\":30000.0,\"shutter_lag_ms\":1.0,\"cover_ms\":300.0,\"suction_min_mbar\":10.0,\"suction_max_mbar\":150.0,\"suction_min_ms\":100.0,\"suction_max_ms\":60000.0,\"reach_ms\":2000.0,\"rest_ms\":5000.0,\"control_period_ms\":50.0,\"camera_c\":5.0,\"source_w\":0.001,\"dose_ws\":10.0}"

#define FIBERS 28
#define SHUTTER_MAX_US 30000000
#define SUCTION_MAX_UBAR 150000
#define SUCTION_MAX_US 60000000
#define REST_US 5000000
#define SOURCE_W 0.001
#define DOSE_WS 10.0
#define DOSE_NANO_WS 10000000000

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
  X(do_head_site, "HEAD:SITE", "<label>,<deg>", ARMED, "") \
  X(get_head_site, "HEAD:SITE?", "", 0, "") \
  X(do_head_free, "HEAD:FREE", "", BARE, "") \
  X(do_pump, "PUMP", "ON,<ms>,<mbar>|VENT", ARMED, "VENT") \
  X(get_pump, "PUMP?", "", 0, "") \
  X(get_pump_last, "PUMP:LAST?", "", 0, "") \
  X(get_pres, "PRES?", "", 0, "") \
  X(do_led, "LED", "<level>", ARMED, "0") \
  X(get_led, "LED?", "", 0, "") \
  X(do_shut, "SHUT", "OPEN,<ms>|CLOSE", ARMED, "CLOSE") \
  X(get_shut, "SHUT?", "", 0, "") \
  X(get_shut_last, "SHUT:LAST?", "", 0, "") \
  X(get_shut_coun, "SHUT:COUN?", "", 0, "") \
  X(do_fib, "FIB", "<n>|ALL", 0, "") \
  X(get_fib, "FIB?", "", 0, "") \
  X(do_cam_trig, "CAM:TRIG", "<token>", 0, "") \
  X(get_cam_temp, "CAM:TEMP?", "", 0, "") \
  X(get_dose, "DOSE?", "", 0, "") \
  X(do_dose_new, "DOSE:NEW", "<token>", 0, "")

#endif
