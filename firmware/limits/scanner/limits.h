/* Limits of the scanner box of rig 'dome'.
 * Made by tools/make_firmware_limits.py. */
#ifndef FIRMWARE_LIMITS_H
#define FIRMWARE_LIMITS_H

#include "core/text.h"

#define BOX_KIND "scanner"
#define BOX_MODEL "SCANNER1"
#ifndef BOX_SERIAL
#define BOX_SERIAL "SC-0001"
#endif
#define BOX_FIRMWARE "1.0"
#define BOX_PROTOCOL "1"
#define BOX_CAPABILITIES "{\"kind\":\"scanner\",\"protocol\":1,\"protocol_minor\":3,\"lease_min_ms\":300,\"lease_max_ms\":5000,\"projectors\":2,\"cameras\":4,\"columns\":[800,800],\"rows\":[1280,1280],\"period_px\":32,\"phase_steps\":6,\"settle_ms\":20.0,\"min_show_ms\":1.0,\"max_show_ms\":500.0,\"dose_ws\":50.0}"

#define PROJECTORS 2
#define CAMERAS 4
#define SETTLE_US 20000
#define MAX_SHOW_US 500000
#define DOSE_NANO_WS 50000000000
#define DOSE_WS 50.0
static const FLASH uint16_t COLUMN_PATTERNS[] = {12, 12};
static const FLASH uint16_t ROW_PATTERNS[] = {13, 13};
static const FLASH uint32_t RELEASED_CAMERAS[] = {3, 12};
static const FLASH double PROJECTOR_W[] = {0.4, 0.4};

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
  X(do_proj, "PROJ", "<n>", 0, "") \
  X(get_proj, "PROJ?", "", 0, "") \
  X(do_pat, "PAT", "COL,<k>|ROW,<k>|FULL", 0, "") \
  X(get_pat, "PAT?", "", 0, "") \
  X(do_trig, "TRIG", "<token>,<ms>", ARMED, "") \
  X(get_trig_last, "TRIG:LAST?", "", 0, "") \
  X(get_trig_coun, "TRIG:COUN?", "", 0, "") \
  X(do_cam_trig, "CAM:TRIG", "<token>", 0, "") \
  X(do_safe_eyes, "SAFE:EYES", "OPEN|CLOSED|SHIELDED", 0, "") \
  X(get_safe_eyes, "SAFE:EYES?", "", 0, "") \
  X(get_dose, "DOSE?", "", 0, "") \
  X(do_dose_new, "DOSE:NEW", "<token>", 0, "")

#endif
