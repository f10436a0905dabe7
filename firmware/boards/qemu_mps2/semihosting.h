/* Files and exit through the emulator (ARM semihosting, version 2). */
#ifndef SEMIHOSTING_H
#define SEMIHOSTING_H

#include <stddef.h>
#include <stdint.h>

typedef enum { SEMIHOSTING_READ = 1, SEMIHOSTING_WRITE = 5 } semihosting_mode;

/* A handle, or -1. */
int32_t semihosting_open(const char *path, semihosting_mode mode);

/* Whether all bytes were read, or written. */
int semihosting_read(int32_t handle, void *buffer, size_t bytes);
int semihosting_write(int32_t handle, const void *buffer, size_t bytes);

/* The emulator's arguments, split at spaces in place; returns how many of at most `limit`. */
size_t semihosting_arguments(char *buffer, size_t bytes, char **arguments, size_t limit);

__attribute__((noreturn)) void semihosting_exit(int code);

#endif
