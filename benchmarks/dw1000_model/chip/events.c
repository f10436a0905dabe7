/* Virtual time: a heap of events, and one coroutine for each program. SYS_STATUS and the IRQ line, which wake programs. */
#define _GNU_SOURCE
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <ucontext.h>

#include "model.h"

#if defined(__SANITIZE_ADDRESS__)
#include <sanitizer/common_interface_defs.h>
#endif

#define STACK_BYTES ((size_t)512 * 1024)
#define LONGEST_S 1e6
#define LOOK_S 1e-7

struct coroutine {
    ucontext_t context;
    coroutine *next;
    dw1000_air *air;
    dw1000_chip *chip;
    void (*run)(dw1000_chip *, void *);
    void *argument;
    void *stack;
    uint32_t epoch; /* of its event: one that carries another is void */
    bool ended;
#if defined(__SANITIZE_ADDRESS__)
    void *fake_stack;
    const void *bottom;
    size_t size;
#endif
};

static void *or_end(void *fresh) {
    if (fresh == NULL) {
        fputs("dw1000_model: no memory\n", stderr);
        abort();
    }
    return fresh;
}

void *dw1000_memory(size_t bytes) {
    return or_end(calloc(1, bytes));
}

static bool sooner(const event *a, const event *b) {
    return a->at != b->at ? a->at < b->at : a->order < b->order;
}

static void insert(dw1000_air *air, event added) {
    size_t at = air->event_count++;
    for (; at > 0 && sooner(&added, &air->events[(at - 1) / 2]); at = (at - 1) / 2) {
        air->events[at] = air->events[(at - 1) / 2];
    }
    air->events[at] = added;
}

static void push(dw1000_air *air, event added) {
    if (air->event_count == air->event_room) {
        air->event_room = air->event_room ? 2 * air->event_room : 64;
        air->events = or_end(realloc(air->events, air->event_room * sizeof *air->events));
    }
    added.order = air->order++;
    insert(air, added);
}

static event pop(dw1000_air *air) {
    const event first = air->events[0], last = air->events[--air->event_count];
    const size_t count = air->event_count;
    size_t at = 0;
    for (size_t child = 1; child < count; child = 2 * at + 1) {
        if (child + 1 < count && sooner(&air->events[child + 1], &air->events[child])) {
            child++;
        }
        if (!sooner(&air->events[child], &last)) {
            break;
        }
        air->events[at] = air->events[child];
        at = child;
    }
    air->events[at] = last;
    return first;
}

void dw1000_schedule(dw1000_chip *chip, event_group group, instant at, handler *fire, transmission *frame) {
    dw1000_air *const air = chip->air;
    const event added = {at > air->now ? at : air->now, 0, fire, chip, frame, NULL, chip->epoch[group], group};
    push(air, added);
}

void dw1000_cancel(dw1000_chip *chip, event_group group) {
    chip->epoch[group]++;
}

static void resume_at(coroutine *program, instant at) {
    const event added = {at, 0, NULL, NULL, NULL, program, ++program->epoch, GROUP_POWER};
    push(program->air, added);
}

static void switch_to(coroutine *from, coroutine *to) {
    from->air->current = to;
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_start_switch_fiber(from->ended ? NULL : &from->fake_stack, to->bottom, to->size);
#endif
    (void)swapcontext(&from->context, &to->context);
#if defined(__SANITIZE_ADDRESS__)
    __sanitizer_finish_switch_fiber(from->fake_stack, NULL, NULL);
#endif
}

/* Handle events, and let others run, until the current coroutine is to go on. */
static void dispatch(dw1000_air *air) {
    coroutine *const self = air->current;
    for (;;) {
        const event next = pop(air);
        if (next.fire == NULL) {
            if (next.epoch != next.program->epoch || next.program->ended) {
                continue;
            }
            air->now = next.at;
            if (next.program != self) {
                switch_to(self, next.program);
            }
            return;
        }
        if (next.epoch == next.chip->epoch[next.group]) {
            air->now = next.at;
            next.fire(next.chip, next.frame);
        }
    }
}

void dw1000_pass(dw1000_air *air, instant until) {
    if (until < air->now) {
        until = air->now;
    }
    if (air->event_count == 0 || air->events[0].at > until) {
        if (air->current != air->outside || !air->running) {
            air->now = until;
            return;
        }
    }
    resume_at(air->current, until);
    dispatch(air);
}

static void finish(coroutine *self) {
    dw1000_air *const air = self->air;
    self->ended = true;
    if (self->chip->program == self) {
        self->chip->program = NULL;
    }
    if (--air->alive == 0 && air->running) {
        resume_at(air->outside, air->now);
    }
    dispatch(air);
    abort(); /* an ended program is never resumed */
}

static void enter(unsigned high, unsigned low) {
    coroutine *const self = (coroutine *)(((uintptr_t)high << 16 << 16) | (uintptr_t)low);
#if defined(__SANITIZE_ADDRESS__)
    coroutine *const outside = self->air->outside;
    const void *bottom;
    size_t size;
    __sanitizer_finish_switch_fiber(NULL, &bottom, &size);
    if (outside->bottom == NULL) {
        outside->bottom = bottom;
        outside->size = size;
    }
#endif
    self->run(self->chip, self->argument);
    finish(self);
}

bool dw1000_start_outside(dw1000_air *air) {
    air->outside = calloc(1, sizeof *air->outside);
    if (air->outside == NULL) {
        return false;
    }
    air->outside->air = air;
    air->current = air->outside;
    return true;
}

/* Forget programs that have ended, and what was scheduled for them; or all. */
static void sweep(dw1000_air *air, bool all) {
    const size_t count = air->event_count;
    air->event_count = 0;
    for (size_t i = 0; i < count; i++) {
        const event kept = air->events[i];
        if (kept.program == NULL || !kept.program->ended) {
            insert(air, kept); /* never overtakes the one that is read */
        }
    }
    for (coroutine **at = &air->programs; *at != NULL;) {
        coroutine *const program = *at;
        if (all || (program->ended && program != air->current)) {
            *at = program->next;
            (void)munmap(program->stack, STACK_BYTES);
            free(program);
        } else {
            at = &program->next;
        }
    }
}

void dw1000_free_programs(dw1000_air *air) {
    sweep(air, true);
    free(air->outside);
    free(air->events);
}

void dw1000_program(dw1000_chip *chip, void (*run)(dw1000_chip *, void *), void *context) {
    dw1000_air *const air = chip->air;
    if (chip->program != NULL) {
        chip->program->ended = true;
        chip->program = chip->waiter = NULL;
        air->alive--;
    }
    sweep(air, false);
    coroutine *const program = dw1000_memory(sizeof *program);
    program->air = air;
    program->chip = chip;
    program->run = run;
    program->argument = context;
    program->stack =
        mmap(NULL, STACK_BYTES, PROT_READ | PROT_WRITE, MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (program->stack == MAP_FAILED || getcontext(&program->context) != 0) {
        or_end(NULL);
    }
#if defined(__SANITIZE_ADDRESS__)
    program->bottom = program->stack;
    program->size = STACK_BYTES;
#endif
    program->context.uc_stack.ss_sp = program->stack;
    program->context.uc_stack.ss_size = STACK_BYTES;
    makecontext(&program->context, (void (*)(void))enter, 2, (unsigned)((uintptr_t)program >> 16 >> 16),
                (unsigned)(uintptr_t)program);
    program->next = air->programs;
    air->programs = chip->program = program;
    air->alive++;
    resume_at(program, air->now);
}

/* Seconds to units; what is negative or no number is 0. */
static instant duration(double seconds) {
    if (!(seconds > 0)) {
        return 0;
    }
    return (instant)llround(fmin(seconds, LONGEST_S) * (double)UNITS_PER_SECOND);
}

double dw1000_seconds_now(const dw1000_air *air) {
    return (double)air->now / (double)UNITS_PER_SECOND;
}

double dw1000_run(dw1000_air *air, double seconds) {
    air->running = air->alive != 0;
    dw1000_pass(air, air->now + duration(seconds));
    air->running = false;
    return dw1000_seconds_now(air);
}

void dw1000_delay(dw1000_chip *chip, double s) {
    dw1000_pass(chip->air, chip->air->now + duration(s));
}

/* Polling takes time, so that a polling loop advances the virtual time. */
static void look(dw1000_air *air) {
    if (air->current != air->outside) {
        dw1000_pass(air, air->now + duration(LOOK_S));
    }
}

double dw1000_now(dw1000_chip *chip) {
    look(chip->air);
    return dw1000_seconds_now(chip->air);
}

int dw1000_irq(dw1000_chip *chip) {
    look(chip->air);
    return chip->line;
}

void dw1000_wait(dw1000_chip *chip, double at_most_s) {
    if (chip->line) {
        return;
    }
    chip->waiter = chip->air->current;
    dw1000_pass(chip->air, chip->air->now + duration(at_most_s));
    chip->waiter = NULL;
}

static void wake(dw1000_chip *chip) {
    if (chip->waiter != NULL) {
        resume_at(chip->waiter, chip->air->now);
        chip->waiter = NULL;
    }
}

uint64_t dw1000_status_of(const dw1000_chip *chip) {
    const uint64_t mask = dw1000_get(chip, SYS_MASK, 0, 4) & UINT64_C(0x3FFFFFFE);
    return chip->status & mask ? chip->status | ST_IRQS : chip->status;
}

void dw1000_update_line(dw1000_chip *chip) {
    const bool asserted = (dw1000_status_of(chip) & ST_IRQS) != 0;
    const bool active_high = (dw1000_get(chip, SYS_CFG, 0, 4) & CFG_HIRQ_POL) != 0;
    const bool line = asserted == active_high;
    if (line && !chip->line) {
        wake(chip);
    }
    chip->line = line;
}

void dw1000_raise_status(dw1000_chip *chip, uint64_t bits) {
    chip->status |= bits;
    dw1000_update_line(chip);
}

void dw1000_clear_status(dw1000_chip *chip, uint64_t bits) {
    chip->status &= ~bits;
    dw1000_update_line(chip);
}
