/* Registers of the DW1000 with the names of the User Manual, and functions to access them. Internal. */
#ifndef UWB_DW1000_REGISTERS_H
#define UWB_DW1000_REGISTERS_H

#include "uwb_dw1000.h"

/* Register file and sub-address. */
#define DW1000_AT(file, sub) ((uint32_t)(file) << 16 | (uint32_t)(sub))

enum {
    DEV_ID = DW1000_AT(0x00, 0),
    PANADR = DW1000_AT(0x03, 0),
    SYS_CFG = DW1000_AT(0x04, 0),
    TX_FCTRL = DW1000_AT(0x08, 0),
    TX_BUFFER = DW1000_AT(0x09, 0),
    DX_TIME = DW1000_AT(0x0A, 0),
    RX_FWTO = DW1000_AT(0x0C, 0),
    SYS_CTRL = DW1000_AT(0x0D, 0),
    SYS_MASK = DW1000_AT(0x0E, 0),
    SYS_STATUS = DW1000_AT(0x0F, 0),
    RX_FINFO = DW1000_AT(0x10, 0),
    RX_BUFFER = DW1000_AT(0x11, 0),
    RX_FQUAL = DW1000_AT(0x12, 0),
    RX_TIME = DW1000_AT(0x15, 0),
    TX_TIME = DW1000_AT(0x17, 0),
    TX_ANTD = DW1000_AT(0x18, 0),
    ACK_RESP_T = DW1000_AT(0x1A, 0),
    TX_POWER = DW1000_AT(0x1E, 0),
    CHAN_CTRL = DW1000_AT(0x1F, 0),
    USR_SFD = DW1000_AT(0x21, 0),
    AGC_TUNE1 = DW1000_AT(0x23, 0x04),
    AGC_TUNE2 = DW1000_AT(0x23, 0x0C),
    AGC_TUNE3 = DW1000_AT(0x23, 0x12),
    EC_CTRL = DW1000_AT(0x24, 0),
    ACC_MEM = DW1000_AT(0x25, 0),
    DRX_TUNE0B = DW1000_AT(0x27, 0x02),
    DRX_TUNE1A = DW1000_AT(0x27, 0x04),
    DRX_TUNE1B = DW1000_AT(0x27, 0x06),
    DRX_TUNE2 = DW1000_AT(0x27, 0x08),
    DRX_SFDTOC = DW1000_AT(0x27, 0x20),
    DRX_TUNE4H = DW1000_AT(0x27, 0x26),
    RXPACC_NOSAT = DW1000_AT(0x27, 0x2C),
    RF_RXCTRLH = DW1000_AT(0x28, 0x0B),
    RF_TXCTRL = DW1000_AT(0x28, 0x0C),
    RF_SENSOR_1 = DW1000_AT(0x28, 0x11),
    RF_SENSOR_2 = DW1000_AT(0x28, 0x12),
    TC_SARC = DW1000_AT(0x2A, 0x00),
    TC_SARL = DW1000_AT(0x2A, 0x03),
    TC_PGDELAY = DW1000_AT(0x2A, 0x0B),
    FS_PLLCFG = DW1000_AT(0x2B, 0x07),
    FS_PLLTUNE = DW1000_AT(0x2B, 0x0B),
    FS_XTALT = DW1000_AT(0x2B, 0x0E),
    AON_WCFG = DW1000_AT(0x2C, 0x00),
    AON_CTRL = DW1000_AT(0x2C, 0x02),
    AON_CFG0 = DW1000_AT(0x2C, 0x06),
    AON_CFG1 = DW1000_AT(0x2C, 0x0A),
    OTP_ADDR = DW1000_AT(0x2D, 0x04),
    OTP_CTRL = DW1000_AT(0x2D, 0x06),
    OTP_RDAT = DW1000_AT(0x2D, 0x0A),
    OTP_SF = DW1000_AT(0x2D, 0x12),
    LDE_THRESH = DW1000_AT(0x2E, 0x0000),
    LDE_CFG1 = DW1000_AT(0x2E, 0x0806),
    LDE_RXANTD = DW1000_AT(0x2E, 0x1804),
    LDE_CFG2 = DW1000_AT(0x2E, 0x1806),
    LDE_REPC = DW1000_AT(0x2E, 0x2804),
    PMSC_CTRL0 = DW1000_AT(0x36, 0x00),
    PMSC_SOFTRESET = DW1000_AT(0x36, 0x03),
    PMSC_CTRL1 = DW1000_AT(0x36, 0x04)
};

/* SYS_CFG */
#define HIRQ_POL (1u << 9)
#define DIS_DRXB (1u << 12)
#define DIS_STXP (1u << 18)
#define RXM110K (1u << 22)
#define RXWTOE (1u << 28)

/* SYS_CTRL */
#define TXSTRT (1u << 1)
#define TXDLYS (1u << 2)
#define TRXOFF (1u << 6)
#define WAIT4RESP (1u << 7)
#define RXENAB (1u << 8)

/* SYS_STATUS; the fifth octet is bits 32 to 39 */
#define CPLOCK ((uint64_t)1 << 1)
#define TXFRS ((uint64_t)1 << 7)
#define LDEDONE ((uint64_t)1 << 10)
#define RXPHE ((uint64_t)1 << 12)
#define RXFCG ((uint64_t)1 << 14)
#define RXFCE ((uint64_t)1 << 15)
#define RXRFSL ((uint64_t)1 << 16)
#define RXRFTO ((uint64_t)1 << 17)
#define LDEERR ((uint64_t)1 << 18)
#define RXOVRR ((uint64_t)1 << 20)
#define RXPTO ((uint64_t)1 << 21)
#define SLP2INIT ((uint64_t)1 << 23)
#define RXSFDTO ((uint64_t)1 << 26)
#define HPDWARN ((uint64_t)1 << 27)
#define AFFREJ ((uint64_t)1 << 29)
#define TXPUTE ((uint64_t)1 << 34)
#define TX_BITS 0xF8u /* AAT to TXFRS */
/* RXPRD to LDEERR, RXPTO, RXSFDTO, AFFREJ */
#define RX_BITS 0x2427FF00u
#define RX_ERRORS (RXPHE | RXFCE | RXRFSL | LDEERR | RXOVRR | RXSFDTO | AFFREJ)
#define RX_TIMEOUTS (RXRFTO | RXPTO)

/* Events that raise the IRQ line: a received frame, or an error. */
#define UWB_DW1000_INTERRUPTS ((uint32_t)(RXFCG | RX_ERRORS | RX_TIMEOUTS))

/* Value of PANADR, which is otherwise unused because the exchange filters frames: after a reset it reads as ones. */
#define UWB_DW1000_CANARY 0x5542A55Au

/* Read or write `bytes` octets of a register, in one chip-select period. */
uwb_dw1000_status uwb_dw1000_read(uwb_dw1000 *chip, uint32_t at, uint8_t *octets, size_t bytes);
uwb_dw1000_status uwb_dw1000_write(uwb_dw1000 *chip, uint32_t at, const uint8_t *octets, size_t bytes);

/* Read or write a little-endian number of up to 8 octets. */
uwb_dw1000_status uwb_dw1000_get(uwb_dw1000 *chip, uint32_t at, size_t bytes, uint64_t *value);
uwb_dw1000_status uwb_dw1000_set(uwb_dw1000 *chip, uint32_t at, size_t bytes, uint64_t value);

/* Write a list of registers; the last entry has 0 bytes. */
typedef struct {
    uint32_t at;
    uint32_t bytes;
    uint32_t value;
} uwb_dw1000_entry;
uwb_dw1000_status uwb_dw1000_write_list(uwb_dw1000 *chip, const uwb_dw1000_entry *entries);

/* Return the number of symbols of the SFD. */
uint32_t uwb_dw1000_sfd_symbols(const uwb_dw1000_settings *settings);

/* Decode a little-endian number. */
uint64_t uwb_dw1000_from_little_endian(const uint8_t *octets, size_t bytes);

#endif
