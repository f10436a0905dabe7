/* Control of the stub by its main programs. */
#ifndef CORE_H
#define CORE_H

#include "Arduino.h"

enum StubHost { HOST_READS, HOST_SILENT, HOST_CLOSED };

/* The host behaves as `host` from `from_us` until `until_us`, else it reads; it closes the port in
 * the middle of a frame. The bytes that it reads in session n, with
 * the port open, are written to the file `<prefix><n>`. */
void stub_start(const char *prefix, StubHost host, uint64_t from_us, uint64_t until_us);

/* A byte arrives on pin RX. */
void stub_receive(uint8_t byte);

/* Bytes and buffers that the UART has lost. */
int stub_overruns();

/* Do what is due at `now_us`: interrupts, USB packets, watchdog (exit 3). */
void stub_run_events(uint64_t now_us);

/* Let time pass, with events. Defined by the main program. */
void stub_pass(uint32_t us);

/* Write out the last session. */
void stub_finish();

StubHost stub_host_of(const char *name);

#endif
